"""Reading histories: selections, shards, chunk cache, and sources in memory, memory-mapped or streamed."""
