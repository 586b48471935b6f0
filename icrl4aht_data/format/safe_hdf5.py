"""Looking into HDF5 files of others: libhdf5 follows links to other files, loads plugins and believes sizes.

Nothing is asked of it here before that is ruled out. What is refused is a ValueError, what is broken any error that
h5py raises; whoever calls names the file.
"""

from __future__ import annotations

import math
import mmap
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from icrl4aht_data.format.chunks import DEFLATE_RATIO, decode_chunk
from icrl4aht_data.utils.memory import new_array

_low: Any = h5py  # whose types do not know its lower half
h5d, h5l, h5t, h5z = _low.h5d, _low.h5l, _low.h5t, _low.h5z

OLDEST_HDF5 = (1, 10, 5)
"""The first libhdf5 that says where chunks lie."""

SHUFFLE, DEFLATE = h5z.FILTER_SHUFFLE, h5z.FILTER_DEFLATE

_HEAP = b"GCOL\x01"  # how a heap of texts begins
_HEAPS, _HEAP_BYTES = 16, 2**16
_CHUNK_BYTES = 256 * 2**20
_ELEMENT_BYTES = 2**16
_ATTRIBUTES = 16


def exists(group: Any, path: str) -> bool:
    """Whether there is something at a path, to which the file's own links lead.

    Raises:
        ValueError: if a link on the way may lead out of the file.
    """
    return _at(group, path) is not None


def member(group: Any, path: str) -> Any:
    """The group or dataset at a path.

    Raises:
        ValueError: the same.
        KeyError: if there is none.
    """
    found = _at(group, path)
    if found is None:
        raise KeyError(f"{path} is missing")
    return found


def _at(group: Any, path: str) -> Any:
    for part in path.strip("/").split("/"):
        name = part.encode()
        if part in ("", ".") or not isinstance(group, h5py.Group) or not group.id.links.exists(name):
            return None
        if group.id.links.get_info(name).type != h5l.TYPE_HARD:
            raise ValueError(f"{path}: a soft, external or other link, which may lead out of the file")
        group = group[part]
    return group


def attributes(file: h5py.File) -> dict[str, Any]:
    """The file's attributes, if they are few single numbers and texts.

    Raises:
        ValueError: if they are not.
    """
    found = {}
    for number, name in enumerate(file.attrs):
        attribute = file.attrs.get_id(name)
        if number == _ATTRIBUTES or attribute.shape or _kind(attribute) not in (h5t.INTEGER, h5t.STRING):
            raise ValueError(f"attribute {name!r}: expected few attributes, single numbers and texts")
        if _kind(attribute) == h5t.STRING:
            _check_heaps(Path(file.filename))
        found[name] = file.attrs[name]
    return found


def _check_heaps(path: Path) -> None:
    """Whether the heaps of texts are small and sound: libhdf5 stays for ever at an object whose size adds up to 0.

    Raises:
        ValueError: if they are not.
    """
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at, heaps = data.find(_HEAP), 0
        while at >= 0:
            size = int.from_bytes(data[at + 8 : at + 16], "little")
            if size <= len(data) - at:  # else these bytes are no heap
                heaps += 1
                if heaps > _HEAPS or size > _HEAP_BYTES or not _is_sound(data[at : at + size]):
                    raise ValueError(f"texts at byte {at}: not stored as libhdf5 stores them")
            at = data.find(_HEAP, at + 1)


def _is_sound(heap: bytes) -> bool:
    """Each object is a number (2 bytes), 6 more, its size (8 bytes) and itself; number 0 is the room that is left."""
    place = 16
    while place + 16 <= len(heap):
        number, size = (int.from_bytes(heap[place + low : place + high], "little") for low, high in ((0, 2), (8, 16)))
        if number == 0:
            return place + size == len(heap)
        place += 16 + -(-size // 8) * 8
    return place <= len(heap)


def filters(dataset: Any) -> list[int]:
    """The ids of a dataset's filters, if all that it is made of lies in the file, in numbers or arrays of numbers.

    Raises:
        ValueError: if it is no dataset, or made of anything else.
    """
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"{dataset.name}: not a dataset")
    made = dataset.id.get_create_plist()
    if made.get_layout() == h5d.VIRTUAL or made.get_external_count():
        raise ValueError(f"{dataset.name}: keeps its values in other files")
    if _kind(dataset.id) not in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM) or dataset.id.get_type().get_size() > _ELEMENT_BYTES:
        raise ValueError(f"{dataset.name}: expected numbers, or small arrays of them, found {dataset.dtype}")
    return [made.get_filter(number)[0] for number in range(made.get_nfilters())]


def _kind(what: Any) -> int:
    """The class of an object's type, or of what its arrays hold."""
    kind = what.get_type()
    return kind.get_super().get_class() if kind.get_class() == h5t.ARRAY else kind.get_class()


def read_dataset(dataset: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A dataset of that shape, chunks inflated here: libhdf5 would inflate one to any length.

    Raises:
        ValueError: if it has another shape, filters but for shuffle and deflate, or more rows than its bytes can hold.
        OptionError: if it does not fit into memory.
    """
    used = filters(dataset)
    if used not in ([], [DEFLATE], [SHUFFLE, DEFLATE]):
        raise ValueError(
            f"{dataset.name}: filters {used}: expected deflate, with or without shuffle; `h5repack -f GZIP=6`"
        )
    if dataset.shape != shape or dataset.dtype.kind not in "biuf":
        raise ValueError(f"expected numbers of shape {shape}, found {dataset.dtype} of shape {dataset.shape}")
    size, stored = math.prod(shape) * dataset.dtype.itemsize, dataset.id.get_storage_size()
    if size > (DEFLATE_RATIO if used else 1) * min(stored, dataset.file.id.get_filesize()):
        raise ValueError(f"{dataset.name}: promises {size:,} bytes, its {stored:,} bytes cannot hold them")
    out = new_array(shape, dataset.dtype, dataset.name)
    if not used:
        dataset.read_direct(out)
        return out
    chunk = dataset.chunks
    length = math.prod(chunk) * dataset.dtype.itemsize
    if length > _CHUNK_BYTES:
        raise ValueError(f"{dataset.name}: chunks of {length:,} bytes, expected at most {_CHUNK_BYTES:,}")
    for place in product(*(range(0, rows, step) for rows, step in zip(shape, chunk, strict=True))):
        info = dataset.id.get_chunk_info_by_coord(place)
        if info.byte_offset is None or info.filter_mask or info.size > 2 * length + 64:
            raise ValueError(f"{dataset.name}: the chunk at {place} is missing, or not stored as the dataset says")
        data = dataset.id.read_direct_chunk(place)[1]
        raw = decode_chunk(data, length, dataset.dtype.itemsize if SHUFFLE in used else 1)
        region = tuple(slice(low, low + step) for low, step in zip(place, chunk, strict=True))
        part = out[region]
        part[...] = np.frombuffer(raw, dataset.dtype).reshape(chunk)[tuple(slice(n) for n in part.shape)]
    return out
