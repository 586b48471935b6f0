"""Safe reading of untrusted HDF5 files: libhdf5 itself follows links to other files, loads plugins and trusts sizes.

Each check runs before the libhdf5 call that it protects. Rejected content raises ValueError; damaged content may raise
any error of h5py. Callers add the file's name to the message.
"""

from __future__ import annotations

import math
import mmap
import re
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from icrl4aht_data.format.chunks import DEFLATE_RATIO, decode_chunk
from icrl4aht_data.utils.system import new_array

_low: Any = h5py  # `Any`, since h5py's type stubs do not have the low-level interface
h5d, h5l, h5t, h5z = _low.h5d, _low.h5l, _low.h5t, _low.h5z

SHUFFLE, DEFLATE = h5z.FILTER_SHUFFLE, h5z.FILTER_DEFLATE

_SUPERBLOCKS = tuple(b"\x89HDF\r\n\x1a\n" + bytes([version, 8, 8]) for version in (2, 3))  # 8-byte offsets and lengths
_LOCAL_HEAP = re.compile(rb"HEAP\0.{8}\0{3}", re.DOTALL)  # \0{3}: libhdf5 rejects heaps of a terabyte or more

_CHUNK_BYTES = 256 * 2**20
_ELEMENT_BYTES = 2**16
_ATTRIBUTES = 16


def check_no_local_heap(path: Path) -> None:
    """Check that a shard has no local heap: a forged heap can have an endless free list, which libhdf5 would follow.

    Shards written by this package have no local heap, since groups in the format of HDF5 1.8 need none.

    Raises:
        ValueError: if the file has a local heap, or its format is older than HDF5 1.8.
    """
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if not data[:11].startswith(_SUPERBLOCKS):
            raise ValueError("expected an HDF5 superblock of version 2 or 3")
        if found := _LOCAL_HEAP.search(data):
            raise ValueError(f"expected no local heap, found one at byte {found.start()}")


def find_node(group: Any, path: str) -> Any:
    """Return the group or dataset at a path relative to a group; None if the path does not exist.

    Raises:
        ValueError: if an HDF5 link on the path may lead to another file.
    """
    for part in path.strip("/").split("/"):
        name = part.encode()
        if part in ("", ".") or not isinstance(group, h5py.Group) or not group.id.links.exists(name):
            return None
        if group.id.links.get_info(name).type != h5l.TYPE_HARD:
            raise ValueError(f"{path}: expected a hard link, found an HDF5 link that may lead to another file")
        group = group[part]
    return group


def read_attributes(file: h5py.File) -> dict[str, Any]:
    """Return the file's attributes by name; the value of a string attribute is the type `str`, not the string.

    Strings are not read, because HDF5 stores strings in a global heap, which may be forged to be endless.

    Raises:
        ValueError: if there are too many attributes, or an attribute is not a single number or string.
    """
    found = {}
    for number, name in enumerate(file.attrs):
        attribute = file.attrs.get_id(name)
        if number == _ATTRIBUTES or attribute.shape or _type_class(attribute) not in (h5t.INTEGER, h5t.STRING):
            raise ValueError(
                f"attribute {name!r}: expected a single number or string, and at most {_ATTRIBUTES} attributes in all"
            )
        found[name] = file.attrs[name] if _type_class(attribute) == h5t.INTEGER else str
    return found


def filter_ids(dataset: Any) -> list[int]:
    """Return the ids of a dataset's filters.

    Raises:
        ValueError: if the object is not a dataset of numbers, or of small arrays of numbers, stored in this file.
    """
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"{dataset.name}: expected a dataset, found another object")
    properties = dataset.id.get_create_plist()
    if properties.get_layout() == h5d.VIRTUAL or properties.get_external_count():
        raise ValueError(f"{dataset.name}: expected values in this file, found values in other files")
    is_number = _type_class(dataset.id) in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM)
    if not is_number or dataset.id.get_type().get_size() > _ELEMENT_BYTES:
        raise ValueError(f"{dataset.name}: expected numbers or small arrays of numbers, found {dataset.dtype}")
    return [properties.get_filter(number)[0] for number in range(properties.get_nfilters())]


def _type_class(what: Any) -> int:
    """Return the HDF5 type class of a dataset or attribute; for an array type, the class of the array's elements."""
    kind = what.get_type()
    return kind.get_super().get_class() if kind.get_class() == h5t.ARRAY else kind.get_class()


def read_dataset(dataset: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a dataset's values; chunks are inflated without libhdf5, which does not limit the inflated size.

    Raises:
        ValueError: if the dataset does not have the shape `shape`, has filters other than shuffle and deflate, or has
            more values than the stored bytes can contain.
        OptionError: if the values do not fit into memory.
    """
    used = filter_ids(dataset)
    if used not in ([], [DEFLATE], [SHUFFLE, DEFLATE]):
        raise ValueError(
            f"{dataset.name}: expected deflate, with or without shuffle, found filters {used}; run `h5repack -f GZIP=6`"
        )
    if dataset.shape != shape or dataset.dtype.kind not in "biuf":
        raise ValueError(f"expected numbers of shape {shape}, found {dataset.dtype} of shape {dataset.shape}")
    size, stored = math.prod(shape) * dataset.dtype.itemsize, dataset.id.get_storage_size()
    if size > (DEFLATE_RATIO if used else 1) * min(stored, dataset.file.id.get_filesize()):
        raise ValueError(f"{dataset.name}: its {stored:,} stored bytes cannot contain the declared {size:,} bytes")
    out = new_array(shape, dataset.dtype, dataset.name)
    if not used:
        dataset.read_direct(out)
        return out
    chunk = dataset.chunks
    length = math.prod(chunk) * dataset.dtype.itemsize
    if length > _CHUNK_BYTES:
        raise ValueError(f"{dataset.name}: chunks of {length:,} bytes, expected at most {_CHUNK_BYTES:,}")
    for corner in product(*(range(0, rows, step) for rows, step in zip(shape, chunk, strict=True))):
        info = dataset.id.get_chunk_info_by_coord(corner)
        if info.byte_offset is None or info.filter_mask or info.size > 2 * length + 64:
            raise ValueError(f"{dataset.name}: the chunk at {corner} is missing, or contradicts the dataset's filters")
        data = dataset.id.read_direct_chunk(corner)[1]
        raw = decode_chunk(data, length, dataset.dtype.itemsize if SHUFFLE in used else 1)
        part = out[tuple(slice(low, low + step) for low, step in zip(corner, chunk, strict=True))]
        part[...] = np.frombuffer(raw, dataset.dtype).reshape(chunk)[tuple(slice(n) for n in part.shape)]
    return out
