"""Make state records of the game, random or from given fields."""

from __future__ import annotations

import numpy as np

from icrl4aht_data.overcooked.cells import COOKED, FACINGS, PLATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import (
    BUTTON_STEPS,
    POT_STEPS,
    State,
    columns,
    ingredient_count,
    pack,
    possible_items,
    record_size,
)


def random_records(layout: Layout, size: int, rng: np.random.Generator) -> np.ndarray:
    """Return random valid records, uint8 of shape (size, S); most have items in hands, in pots and on counters."""
    items = possible_items(layout).nonzero()[0]
    counts = ingredient_count(items)
    in_pot = items[items & PLATE == 0]
    useful = np.array([0, PLATE, *(layout.ingredient_item(i) for i in layout.ingredients)])
    dishes = items[items & (PLATE | COOKED) == PLATE | COOKED]
    matching = layout.recipe_items | PLATE | COOKED

    def random_items(*shape):
        kind = rng.random(shape)
        some = np.where(kind < 0.75, rng.choice(useful, shape), rng.choice(dishes, shape))
        return np.where(kind > 0.85, rng.choice(matching, shape), some)

    positions = np.stack([rng.choice(room, size) for room in layout.rooms], axis=1)
    clash = positions[:, 0] == positions[:, 1]
    positions[clash] = layout.rooms[0][0], layout.rooms[1][-1]
    pots, buttons, counters = len(layout.pots), len(layout.buttons), len(layout.counters)
    pot_items = rng.choice(in_pot, (size, pots), p=_fullness_weights(counts[items & PLATE == 0]))
    raw_full = (ingredient_count(pot_items) == 3) & (pot_items & COOKED == 0)
    fill = rng.random((size, counters)) < rng.random((size, 1)) * 0.5
    return pack(
        State(
            *(
                np.asarray(field).astype(np.uint8)
                for field in (
                    positions,
                    rng.integers(0, 4, (size, 2)),
                    random_items(size, 2),
                    rng.choice(layout.recipe_items, size),
                    rng.integers(0, 2, size),
                    pot_items,
                    np.where(raw_full, rng.integers(1, POT_STEPS + 1, (size, pots)), 0),
                    rng.integers(0, BUTTON_STEPS + 1, (size, buttons)),
                    np.where(fill, random_items(size, counters), 0),
                )
            )
        )
    )


def _fullness_weights(counts: np.ndarray) -> np.ndarray:
    weight = np.where(counts >= 2, 2.0, 1.0)
    return weight / weight.sum()


def state_record(layout: Layout, ego: tuple[int, int, str], teammate: tuple[int, int, str], **fields) -> np.ndarray:
    """Return a state record, uint8 of shape (1, S), with agents at (x, y, facing) and the given fields.

    Fields are hands=(ego's item, teammate's item), recipe, delivered, the sequences pot_items, pot_timers and buttons,
    and counters={(x, y): item}. Other fields are empty, but the default recipe is the first one.
    """
    record = np.zeros((1, record_size(layout)), np.uint8)
    where = columns(layout)
    record[:, where.positions] = [y * layout.width + x for x, y, _ in (ego, teammate)]
    record[:, where.facings] = [FACINGS.index(facing) for *_, facing in (ego, teammate)]
    record[:, where.recipe] = layout.recipe_items[0]
    for (x, y), item in fields.pop("counters", {}).items():
        record[:, where.counters.start + layout.counters.index(y * layout.width + x)] = item
    for name, value in fields.items():
        record[:, getattr(where, name)] = value
    return record
