"""The index as a Parquet file."""

from __future__ import annotations

from pathlib import Path

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import ENTRY_HINTS
from icrl4aht_data.utils.disk import explain_full_disk
from icrl4aht_data.utils.files import atomic_write
from icrl4aht_data.utils.installation import install_command
from icrl4aht_data.utils.new_file import MARK, check_new_file


def to_parquet(dataset: Dataset, path: Path, *, overwrite: bool = False) -> Path:
    """Write the selection's index as a Parquet file, one row per history. Needs pyarrow, of the extra `hf`.

    Args:
        dataset: a release, or a part of one.
        path: the file to write.
        overwrite: replace a Parquet file of this function at `path`.

    Raises:
        OptionError: if pyarrow is not installed, or `path` may not be written, see `new_file.check_new_file`, or
            is inside the release.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise OptionError(f"Parquet needs pyarrow: {install_command('hf')}") from error
    check_new_file(path, overwrite)
    if path.resolve().is_relative_to(dataset.root.resolve()):
        raise OptionError(f"{path}: is inside {dataset.root}, which is read; give another path")
    types = {float: pa.float64(), int: pa.int64(), int | None: pa.int64(), str: pa.string(), bool: pa.bool_()}
    types |= {float | None: pa.float64(), tuple[int, int, int]: pa.list_(pa.int64())}
    schema = pa.schema([(name, types[hint]) for name, hint in ENTRY_HINTS.items()], {MARK: "index"})
    rows = pa.Table.from_pylist([entry.to_json() for entry in dataset.entries], schema)
    with explain_full_disk(path), atomic_write(path) as partial, partial.open("wb") as stream:
        pq.write_table(rows, stream)  # which would leave a file open where it fails
    return path
