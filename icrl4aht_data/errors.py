"""Errors that this package raises on bad input, with one base class, and its warnings.

Messages name the file or value, what was expected, what was found, and what to do next.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class Icrl4ahtError(Exception):
    """Base class of every error that this package raises on bad input."""


class UnknownNameError(Icrl4ahtError, ValueError):
    """A layout, split, track, family, field or option that does not exist."""


class EmptySelectionError(Icrl4ahtError, ValueError):
    """The filter is valid but no history matches it."""


class OptionError(Icrl4ahtError, ValueError):
    """An option has an impossible value (a window of no steps, layouts whose observations differ in shape)."""


class PositionError(Icrl4ahtError, IndexError):
    """A sequence of histories or episodes has no item at the position."""


class PositionTypeError(Icrl4ahtError, TypeError):
    """The position in a sequence of histories or episodes is neither an integer nor a slice."""


class LabelsMissingError(Icrl4ahtError):
    """Expert or teammate actions were requested from histories that have none."""


class NotStoredError(Icrl4ahtError):
    """State records, tasks or measured returns were requested from a release that has none."""


class ReleaseError(Icrl4ahtError):
    """A release cannot be read; base class of the errors that say why."""


class RootNotFoundError(ReleaseError, FileNotFoundError):
    """The root is not a release folder."""


class IndexFormatError(ReleaseError):
    """meta/info.json, a line of meta/histories.jsonl, or another text file of meta/ is missing or malformed."""


class ChunkTableError(ReleaseError):
    """A shard's chunk table is missing or malformed."""


class ShardMissingError(ReleaseError, FileNotFoundError):
    """A shard named by the index does not exist."""


class ShardUnreadableError(ReleaseError, OSError):
    """A shard exists, but this user may not read it, or the disk fails."""


class ShardCorruptError(ReleaseError):
    """A shard is not HDF5, or a chunk's checksum is wrong."""


class ShardTruncatedError(ShardCorruptError):
    """A shard is shorter than its chunk table says."""


class ShardMismatchError(ReleaseError):
    """Index, chunk table and shard disagree."""


class PublishedFormatError(ReleaseError):
    """Files in the published format are missing or malformed, or do not contain what a release needs."""


class FormatTooNewError(ReleaseError):
    """The release was written in a newer format than this package reads."""


class FormatTooOldError(ReleaseError):
    """The release was written in an older format than this package reads."""


class RemoteError(ReleaseError, OSError):
    """A remote failed after all retries, or returned content that differs from its manifest.

    Args:
        message: names the address.
        missing: whether the remote has no such file.
        is_content: whether the remote answered, without the file or with another content.
    """

    def __init__(self, message: str, missing: bool = False, is_content: bool = False) -> None:
        super().__init__(message)
        self.missing, self.is_content = missing, missing or is_content


class OfflineError(ReleaseError):
    """A file is not on this machine and may not be fetched: HF_HUB_OFFLINE or ICRL4AHT_OFFLINE is set."""


class UnsafePathError(ReleaseError):
    """A path in a release points outside its folder."""


class CacheError(Icrl4ahtError):
    """The cache folder has no room, cannot be written, or is not a folder."""


class DiskFullError(Icrl4ahtError, OSError):
    """The disk that is written to is full; names the file or folder, the disk, and its free space."""


class UploadError(Icrl4ahtError):
    """Uploading a release failed, or the repository's content differs from it; names the repository."""


class PluginError(Icrl4ahtError):
    """An object that another installed package registers cannot be used; names the package and the entry point."""


class TaskFormatError(Icrl4ahtError, ValueError):
    """A task line is malformed."""


class WeakLabelsWarning(UserWarning):
    """The expert actions of some tasks come from a policy that earns far less than the histories do at their end."""


class MixedSplitsWarning(UserWarning):
    """A sampler draws from histories of split `train` together with those of splits that judge a model."""


_LISTED, _COMPARED = 50, 1000  # names that an error lists, and names compared to find the nearest


def unknown(what: str, found: object, valid: Iterable[str]) -> UnknownNameError:
    """Return the error for a name that does not exist; it lists the valid names, and the nearest if one is close."""
    names = list(dict.fromkeys(valid))
    by_small_letters = {name.casefold(): name for name in reversed(names[:_COMPARED])}
    nearest = get_close_matches(str(found).casefold(), by_small_letters, n=1)
    hint = f" Did you mean {by_small_letters[nearest[0]]!r}?" if nearest else ""
    more = f", and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return UnknownNameError(f"unknown {what} {found!r}; valid: {', '.join(names[:_LISTED])}{more}.{hint}")
