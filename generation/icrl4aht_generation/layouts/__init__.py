"""Families of generated layouts; every layout depends only on its family, seed and number."""

from icrl4aht_data.overcooked.solvable import check_solvable
from icrl4aht_generation.layouts.families import find_generated, generate_layouts, split_of
from icrl4aht_generation.layouts.grids import canonical_map

__all__ = ["canonical_map", "check_solvable", "find_generated", "generate_layouts", "split_of"]
