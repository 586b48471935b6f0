"""Chunks with other content, but the size and the CRC-32 of the original: what a chunk table without hashes accepts."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from functools import reduce

import numpy as np

Change = Mapping[int, int]
"""Position of a byte -> bits to flip in it."""


def forge_crc32(data: bytes, changes: Sequence[Change], crc32: int) -> bytes | None:
    """Return the data with some of the changes, at least one, so that it has that CRC-32; None if there is no way.

    The effect of a change on the CRC-32 does not depend on the others, so that a linear system over bits is solved.

    Args:
        data: any bytes.
        changes: changes of different bytes.
        crc32: the checksum wanted.
    """
    zeros, wanted = bytes(len(data)), crc32 ^ zlib.crc32(data)
    basis: dict[int, tuple[int, int]] = {}  # leading bit -> effect, changes
    for number, change in enumerate(changes):
        effect, members = zlib.crc32(_flip(zeros, change)) ^ zlib.crc32(zeros), 1 << number
        while effect and effect.bit_length() in basis:
            known, others = basis[effect.bit_length()]
            effect, members = effect ^ known, members ^ others
        if effect:
            basis[effect.bit_length()] = effect, members
        elif not wanted:  # changes that cancel one another
            return _apply(data, changes, members)
    members = 0
    while wanted:
        if wanted.bit_length() not in basis:
            return None
        known, others = basis[wanted.bit_length()]
        wanted, members = wanted ^ known, members ^ others
    return _apply(data, changes, members) if members else None


def with_trailing_bytes(data: bytes, content: bytes) -> bytes:
    """Return a chunk that inflates to `content`, with the size and CRC-32 of `data` by bytes behind the stream."""
    forged = zlib.compress(content, 9).ljust(len(data), b"\0")
    last_bits = [{len(data) - 4 + bit // 8: 1 << bit % 8} for bit in range(32)]
    found = forge_crc32(forged, last_bits, zlib.crc32(data))
    assert found is not None
    return found


def with_other_actions(data: bytes) -> bytes:
    """Return a chunk with other actions in a valid deflate stream of the size and CRC-32 of `data`.

    Three actions a, b, c become a + 1, b - 2, c + 1 or a - 1, b + 2, c - 1, which keeps the Adler-32 at the end of the
    stream.

    Args:
        data: a chunk of actions, one byte each, that is stored by deflate without compression, in one block.
    """
    actions = zlib.decompress(data)
    first = data.index(actions)
    changes = []
    for start in range(0, len(actions) - 2, 3):
        old = actions[start : start + 3]
        for sign in (1, -1):
            new = old[0] + sign, old[1] - 2 * sign, old[2] + sign
            if min(new) >= 0 and max(new) <= 5:
                changes.append({first + start + k: old[k] ^ new[k] for k in range(3)})
                break
    found = forge_crc32(data, changes, zlib.crc32(data))
    assert found is not None
    return found


def _flip(data: bytes, change: Change) -> bytes:
    flipped = np.frombuffer(data, np.uint8).copy()
    for position, bits in change.items():
        flipped[position] ^= bits
    return flipped.tobytes()


def _apply(data: bytes, changes: Sequence[Change], members: int) -> bytes:
    return reduce(_flip, (change for number, change in enumerate(changes) if members >> number & 1), data)
