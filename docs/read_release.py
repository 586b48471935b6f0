"""A reader of releases in Python and NumPy, which needs no HDF5 library; docs/format.md explains the format."""

import hashlib
import json
import zlib
from pathlib import Path

import numpy as np

ARRAYS = {  # rows per chunk, element in a full shard, element in a lite one; None for records and observations
    "state": (1000, None, None),
    "actions": (2000, "<i4", "i1"),
    "rewards": (2000, "<f4", "i1"),
    "dones": (2000, "?", "?"),
    "teammate_actions": (2000, "<i4", "i1"),
    "expert_actions": (2000, "<i4", "i1"),
    "oracle_actions": (2000, "<i4", "i1"),
    "episode_end_state": (1000, None, None),
    "obs": (200, None, None),
}
ABSENT = {"full": (), "lite": ("obs",), "observations": ("state", "episode_end_state")}


def read(root, history, wanted):
    """Return one array of a history, read by byte ranges."""
    info = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))
    lines = [json.loads(text) for text in (root / "meta/histories.jsonl").read_text(encoding="utf-8").splitlines()]
    shard, first = lines[history]["shard"], 0  # first line of the array in the chunk table
    table = np.load(root / "meta/chunks" / Path(shard).relative_to("data").with_suffix(".npy"))
    for line in (line for line in lines if line["shard"] == shard):
        for name, (chunk, *elements) in ARRAYS.items():
            present = line.get(f"has_{name}", True)
            if present and name not in ABSENT[info["kind"]]:
                chunks = -(-line["episodes" if name == "episode_end_state" else "T"] // chunk)
                if (line["history_id"], name) == (history, wanted):
                    size = line["obs_shape"] if name == "obs" else [parse_layout(info["layouts"][line["layout"]])["S"]]
                    dtype = np.dtype(elements[info["kind"] == "lite"] or ("u1", tuple(size)))
                    return decode(root / shard, table[first : first + chunks], dtype)
                first += chunks
    raise KeyError(wanted)


def decode(shard, table, dtype):
    """Return the rows of consecutive chunks, without padding."""
    parts = []
    with shard.open("rb") as file:
        for offset, size, rows, _, digest in table.tolist():
            file.seek(offset)
            stored = file.read(size)
            if hashlib.blake2b(stored, digest_size=16).digest() != digest.tobytes():
                raise ValueError(f"{shard}: bytes {offset}..{offset + size} are damaged")
            planes = np.frombuffer(zlib.decompress(stored), "u1").reshape(dtype.itemsize, -1)  # byte k of all elements
            parts.append(np.frombuffer(planes.T.tobytes(), dtype.base).reshape(-1, *dtype.shape)[:rows])
    return np.concatenate(parts)


def parse_layout(entry):
    """Return what a layout of info.json determines: record size S, cells of pots, buttons, counters, pile ids."""
    width, cells = len(entry["map"][0]), "".join(entry["map"])
    floor, neighbours = [cell for cell, letter in enumerate(cells) if letter == "A"], []
    for cell in floor:  # the loop body extends it: a flood fill from both starts
        for near in (cell - width, cell - 1, cell + 1, cell + width):
            neighbours.append(near)
            if cells[near] in " A" and near not in floor:
                floor.append(near)
    pots, buttons = ([cell for cell, letter in enumerate(cells) if letter == wanted] for wanted in "PL")
    counters = sorted({cell for cell in neighbours if cells[cell] == "W"})
    piles = sorted({int(letter) for letter in cells if letter.isdigit()})
    size = 8 + 2 * len(pots) + len(buttons) + len(counters)
    layout = {"map": cells, "width": width, "channels": entry["obs_shape"][2], "S": size}
    return layout | {"pots": pots, "buttons": buttons, "counters": counters, "piles": piles}


def unpack(layout, record):
    """Return the parts of a state record by name."""
    names = ("cells", "facings", "hands", "recipe", "delivered", "pot_items", "pot_timers", "buttons", "counters")
    pots, buttons = len(layout["pots"]), len(layout["buttons"])
    return dict(zip(names, np.split(record, np.cumsum([2, 2, 2, 1, 1, pots, pots, buttons])), strict=True))


def observe(layout, record, agent=0):
    """Return the observation of an agent, 0 (ego) or 1 (teammate): uint8 (5, 5, C)."""
    cells, width, piles, n = layout["map"], layout["width"], layout["piles"], max(layout["piles"]) + 1
    state, grid = unpack(layout, record), np.zeros((len(layout["map"]), layout["channels"]), np.uint8)

    def counts(item):
        return [item >> 2 + 2 * piles.index(i) & 3 if i in piles else 0 for i in range(n)]

    def as_channels(item):  # 2 + n: plate, cooked, counts
        return [item & 1, item >> 1 & 1, *counts(item)]

    for player, first in ((agent, 0), (1 - agent, 7 + n)):  # self, other: position 1, facing 4, hand 2 + n
        here = grid[state["cells"][player]]
        here[first] = here[first + 1 + state["facings"][player]] = 1
        here[first + 5 : first + 7 + n] = as_channels(int(state["hands"][player]))
    static, item, recipe = 14 + 2 * n, 20 + 3 * n, 22 + 4 * n
    for cell, letter in enumerate(cells):
        if letter in "WXPRLB":  # static 6: wall, goal, pot, indicator, button, plate pile
            grid[cell, static + "WXPRLB".index(letter)] = 1
        if letter.isdigit():  # ingredient piles n
            grid[cell, static + 6 + int(letter)] = 1
        if letter == "R" or (letter == "L" and state["buttons"][layout["buttons"].index(cell)]):  # recipe 2 + n
            grid[cell, recipe : recipe + 2 + n] = as_channels(int(state["recipe"][0]))
        if letter == "X" and layout["channels"] > 25 + 5 * n:  # delivery indicator 1
            grid[cell, -1] = state["delivered"][0]
    for part, items in (("pots", "pot_items"), ("counters", "counters")):  # item on the cell 2 + n
        for cell, held in zip(layout[part], state[items].tolist(), strict=True):
            grid[cell, item : item + 2 + n] = as_channels(held)
    grid[layout["pots"], recipe + 2 + n] = state["pot_timers"]  # pot timer 1
    padded = np.pad(grid.reshape(-1, width, layout["channels"]), ((2, 2), (2, 2), (0, 0)))
    y, x = divmod(int(state["cells"][agent]), width)
    return padded[y : y + 5, x : x + 5]


def canonical_positions(layout):
    """Return the place of each own channel of a layout among the canonical channels."""
    n, places, first = max(layout["piles"]) + 1, [], 0
    for fixed in (7, 7, 6, 2, 2):  # self, other, static and piles, item, recipe: channels of each before its n counts
        places += range(first, first + fixed + n)
        first += fixed + 4
    return [*places, first, first + 1][: layout["channels"]]  # pot timer, and perhaps the delivery indicator
