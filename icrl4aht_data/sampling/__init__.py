"""AD and DPT batches: draws, samplers, prefetching."""
