"""A decoder of the pages that `icrl4aht-data browse` writes, independent of the page's JavaScript."""

from __future__ import annotations

import base64
import json
import re
import zlib
from typing import Any

import numpy as np


def embedded_data(html: bytes) -> tuple[dict[str, Any], list[bytes]]:
    """Return a page's index and the decompressed data of each history on the page."""
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', html.decode(), re.DOTALL)
    data = json.loads(text)
    index, *histories = (zlib.decompress(base64.b64decode(one)) for one in (data["index"], *data["histories"]))
    return json.loads(index), histories


def embedded_episodes(index: dict[str, Any], facts: dict[str, Any], content: bytes) -> dict[int, dict[str, np.ndarray]]:
    """Return the columns of each embedded episode, as episode number -> column name -> values.

    The column "state" is uint8 of shape (frames, S).
    """
    size, names = index["layouts"][facts["layout"]]["record_size"], facts["columns"]
    columns = np.frombuffer(content, np.uint8).reshape(size + len(names), sum(facts["frames"]))
    named = {"state": columns[:size].T, **dict(zip(names, columns[size:], strict=True))}
    named["rewards"] = named["rewards"].view(np.int8)
    ends = np.cumsum(facts["frames"])[:-1]
    parts = {name: np.split(values, ends) for name, values in named.items()}
    return {number: {name: parts[name][at] for name in parts} for at, number in enumerate(facts["shown"])}
