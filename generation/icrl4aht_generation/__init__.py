"""Rebuilds the ICRL4AHT dataset from the environment and the teammates."""
