"""Exceptions of this package, with one base class, and warnings of this package.

An error's message names the file or value, what was expected, what was found, and what to do next.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class Icrl4ahtError(Exception):
    """Base class of every error that this package raises on bad input."""


class UnknownNameError(Icrl4ahtError, ValueError):
    """The name of a layout, split, track, family, field or option does not exist."""


class EmptySelectionError(Icrl4ahtError, ValueError):
    """The filters are valid but no history matches them."""


class OptionError(Icrl4ahtError, ValueError):
    """An option has an invalid value, such as a window of 0 steps."""


class PositionError(Icrl4ahtError, IndexError):
    """A position is out of range for a sequence of histories or episodes."""


class PositionTypeError(Icrl4ahtError, TypeError):
    """A position in a sequence of histories or episodes is neither an integer nor a slice."""


class LabelsMissingError(Icrl4ahtError):
    """Expert or teammate actions were requested from histories that have none."""


class NotStoredError(Icrl4ahtError):
    """State records, tasks or measured returns were requested from a release that has none."""


class ReleaseError(Icrl4ahtError):
    """Base class of errors about a release that cannot be read."""


class RootNotFoundError(ReleaseError, FileNotFoundError):
    """The given folder is not a release."""


class IndexFormatError(ReleaseError):
    """A text file in meta/, such as info.json or histories.jsonl, is missing or malformed."""


class ChunkTableError(ReleaseError):
    """A shard's chunk table is missing or malformed."""


class ShardMissingError(ReleaseError, FileNotFoundError):
    """A shard named by the index does not exist."""


class ShardUnreadableError(ReleaseError, OSError):
    """A shard exists but cannot be read: no permission, or a disk error."""


class ShardCorruptError(ReleaseError):
    """A shard is not HDF5, or a chunk's checksum is wrong."""


class ShardTruncatedError(ShardCorruptError):
    """A shard is shorter than its chunk table says."""


class ShardMismatchError(ReleaseError):
    """The index, the chunk table and the shard contradict each other."""


class PublishedFormatError(ReleaseError):
    """Files in the published format are missing or malformed, or have missing fields."""


class FormatTooNewError(ReleaseError):
    """The release was written in a newer format than this package reads."""


class FormatTooOldError(ReleaseError):
    """The release was written in an older format than this package reads."""


class RemoteError(ReleaseError, OSError):
    """A remote request failed after all retries, or the fetched file differs from the release's manifest.

    Args:
        message: the error message, which includes the address.
        missing: True if the file does not exist on the remote.
    """

    def __init__(self, message: str, missing: bool = False) -> None:
        super().__init__(message)
        self.missing = missing


class OfflineError(ReleaseError):
    """A file is not on this machine, and HF_HUB_OFFLINE or ICRL4AHT_OFFLINE forbids fetching the file."""


class UnsafePathError(ReleaseError):
    """A path in a release points outside its folder."""


class CacheError(Icrl4ahtError):
    """The cache folder is full, not writable, or not a folder."""


class DiskFullError(Icrl4ahtError, OSError):
    """The disk is full. The message names the file or folder, the disk, and its free space."""


class UploadError(Icrl4ahtError):
    """Uploading a release failed, or the repository differs from the release after the upload."""


class PluginError(Icrl4ahtError):
    """An object registered by another installed package cannot be used."""


class TaskFormatError(Icrl4ahtError, ValueError):
    """A line of a tasks file is malformed."""


class WeakLabelsWarning(UserWarning):
    """The policy that labelled some tasks earns less than half of the ego's return at the end of the histories."""


class MixedSplitsWarning(UserWarning):
    """A sampler draws training histories together with validation or test histories."""


def check_choice(what: str, found: object, valid: Iterable[str]) -> None:
    """Check that a value is one of the valid names.

    Raises:
        UnknownNameError: if the value is not valid; the message lists the valid names and suggests the nearest.
    """
    if not isinstance(found, str) or found not in tuple(valid):  # `in` would fail for an array
        raise unknown_name(what, found, valid)


_LISTED, _COMPARED = 50, 1000  # maximum number of valid names to list, and to compare with an unknown name


def unknown_name(what: str, found: object, valid: Iterable[str]) -> UnknownNameError:
    """Return the error for an unknown name, which lists the valid names and suggests the nearest."""
    names = list(dict.fromkeys(valid))
    by_small_letters = {name.casefold(): name for name in reversed(names[:_COMPARED])}
    nearest = get_close_matches(str(found).casefold(), by_small_letters, n=1)
    hint = f" Did you mean {by_small_letters[nearest[0]]!r}?" if nearest else ""
    more = f", and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return UnknownNameError(f"unknown {what} {found!r}; valid: {', '.join(names[:_LISTED])}{more}.{hint}")
