"""Samplers of AD and DPT batches, random draws, and prefetching."""
