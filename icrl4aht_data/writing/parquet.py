"""The index as a Parquet file."""

from __future__ import annotations

from pathlib import Path

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import JSON_TYPES
from icrl4aht_data.utils.files import atomic_write


def to_parquet(dataset: Dataset, path: Path) -> Path:
    """Write the selection's index as a Parquet file, one row per history. Needs pyarrow, of the extra `hf`.

    Raises:
        OptionError: if pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise OptionError("Parquet needs pyarrow: pip install 'icrl4aht-data[hf]'") from error
    types = {float: pa.float64(), int: pa.int64(), str: pa.string(), bool: pa.bool_(), list: pa.list_(pa.int64())}
    columns = {name: next(types[kind] for kind in types if kind in kinds) for name, kinds in JSON_TYPES.items()}
    rows = pa.Table.from_pylist([entry.to_json() for entry in dataset.entries], pa.schema(list(columns.items())))
    with atomic_write(path) as partial:
        pq.write_table(rows, partial)
    return path
