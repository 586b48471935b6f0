"""Reading of histories: selections, shards, a cache of chunks, and arrays in memory, memory-mapped or streamed."""
