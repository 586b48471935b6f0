"""The folders for cached arrays and for fetched releases, and the size limit of the first.

The cache folder is $ICRL4AHT_CACHE_DIR, else the user's cache folder (`platformdirs`); its size limit is
$ICRL4AHT_CACHE_BYTES (100 GB by default). It is never the release folder: a release contains what its manifest lists
and nothing else, and is often read-only. Deleting the folder costs nothing but time.
"""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs

from icrl4aht_data.errors import OptionError

_DEFAULT_LIMIT = 100 * 10**9

CACHE_VARIABLES = ("ICRL4AHT_CACHE_DIR", "XDG_CACHE_HOME")
"""Environment variables that set the cache folder; below the second one it is called icrl4aht."""

DATA_VARIABLES = ("ICRL4AHT_DATA_DIR", "XDG_DATA_HOME")
"""Environment variables that set the data folder; below the second one it is called icrl4aht."""


def cache_folder() -> Path:
    """The folder of cached arrays, read from the environment at each call; ~/.cache/icrl4aht by default on Linux."""
    own = os.environ.get(CACHE_VARIABLES[0])
    return Path(own).expanduser() if own else platformdirs.user_cache_path("icrl4aht", appauthor=False)


def data_folder() -> Path:
    """The folder of fetched releases, read from the environment at each call; ~/.local/share/icrl4aht by default on
    Linux. It is not a cache: nothing in it is removed."""
    own = os.environ.get(DATA_VARIABLES[0])
    return Path(own).expanduser() if own else platformdirs.user_data_path("icrl4aht", appauthor=False)


def cache_limit() -> int:
    """Most bytes that the cache folder may contain.

    Raises:
        OptionError: if the environment variable is not a number of bytes.
    """
    given = os.environ.get("ICRL4AHT_CACHE_BYTES")
    if not given:
        return _DEFAULT_LIMIT
    try:
        limit = int(float(given))
    except (ValueError, OverflowError):
        limit = -1
    if limit < 0:
        raise OptionError(f"ICRL4AHT_CACHE_BYTES={given!r}: expected a number of bytes, such as 2e11")
    return limit
