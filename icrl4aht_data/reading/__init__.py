"""Reading histories: shards, chunk cache, sources held in memory, memory-mapped or streamed."""
