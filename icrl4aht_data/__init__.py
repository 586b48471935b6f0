"""Learning histories of the ICRL4AHT benchmark: read, sample, verify.

ds = load_icrl4aht(split="train", layout="coord_simple")
batch = ds.ad(batch_size=64, length=500, seed=0)[0]
"""

from icrl4aht_data.benchmark import ACTIONS, FAMILIES, SPLITS, TRACKS
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.draws import Curriculum
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.history import History
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, get_layout
from icrl4aht_data.prefetch import Batches
from icrl4aht_data.sampling import ADBatch, ADSampler, DPTBatch, DPTSampler
from icrl4aht_data.verify import Report, verify_release

__all__ = [
    "ACTIONS",
    "FAMILIES",
    "LAYOUTS",
    "SPLITS",
    "TRACKS",
    "ADBatch",
    "ADSampler",
    "Batches",
    "Curriculum",
    "DPTBatch",
    "DPTSampler",
    "Dataset",
    "History",
    "Icrl4ahtError",
    "Layout",
    "Report",
    "get_layout",
    "load_icrl4aht",
    "verify_release",
]
