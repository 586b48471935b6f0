"""Learning histories of the ICRL4AHT benchmark: read, sample, verify.

ds = load_icrl4aht(split="train", layout="coord_simple")
batch = ds.ad(batch_size=64, length=500, seed=0)[0]
"""

from icrl4aht_data.benchmark.facts import FAMILIES, SOURCES, SPLITS, TRACKS
from icrl4aht_data.checking.report import Report
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.environments import register_environments
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
"""Version of this package, which pyproject.toml reads from here."""

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

register_environments()
