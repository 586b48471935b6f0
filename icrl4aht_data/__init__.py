"""Read, sample and verify the learning histories of the ICRL4AHT benchmark.

ds = load_icrl4aht(split="train", layout="coord_simple")
batch = ds.ad(batch_size=64, length=500, seed=0)[0]

Public names are imported on first use, so that commands start fast.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from icrl4aht_data.environments import register_environments

if TYPE_CHECKING:
    from icrl4aht_data.benchmark.facts import FAMILIES, SOURCES, SPLITS, TRACKS
    from icrl4aht_data.checking.report import Report
    from icrl4aht_data.checking.verify import verify_release
    from icrl4aht_data.dataset import Dataset, load_icrl4aht
    from icrl4aht_data.errors import Icrl4ahtError
    from icrl4aht_data.overcooked.actions import ACTIONS
    from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, get_layout
    from icrl4aht_data.reading.episodes import Episode, Episodes
    from icrl4aht_data.reading.history import History
    from icrl4aht_data.sampling.ad import ADBatch, ADSampler
    from icrl4aht_data.sampling.batches import Batches
    from icrl4aht_data.sampling.dpt import DPTBatch, DPTSampler
    from icrl4aht_data.sampling.draws import Curriculum

__version__ = "0.1.0"
"""Version of this package; pyproject.toml reads it from here."""

__all__ = [
    "ACTIONS",
    "FAMILIES",
    "LAYOUTS",
    "SOURCES",
    "SPLITS",
    "TRACKS",
    "ADBatch",
    "ADSampler",
    "Batches",
    "Curriculum",
    "DPTBatch",
    "DPTSampler",
    "Dataset",
    "Episode",
    "Episodes",
    "History",
    "Icrl4ahtError",
    "Layout",
    "Report",
    "__version__",
    "get_layout",
    "load_icrl4aht",
    "verify_release",
]

_NAMES = {
    "benchmark.facts": ("FAMILIES", "SOURCES", "SPLITS", "TRACKS"),
    "checking.report": ("Report",),
    "checking.verify": ("verify_release",),
    "dataset": ("Dataset", "load_icrl4aht"),
    "errors": ("Icrl4ahtError",),
    "overcooked.actions": ("ACTIONS",),
    "overcooked.layouts": ("LAYOUTS", "Layout", "get_layout"),
    "reading.episodes": ("Episode", "Episodes"),
    "reading.history": ("History",),
    "sampling.ad": ("ADBatch", "ADSampler"),
    "sampling.batches": ("Batches",),
    "sampling.dpt": ("DPTBatch", "DPTSampler"),
    "sampling.draws": ("Curriculum",),
}
"""Module -> the public names that it defines."""

_MODULES = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Return a public name or a module of this package, imported on first use."""
    if name in _MODULES:
        globals()[name] = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
        return globals()[name]
    if not name.startswith("_") and find_spec(f"{__name__}.{name}"):
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


register_environments()
