"""Layouts of this package."""

from icrl4aht_data import Layout

OPEN_KITCHEN = Layout(
    "open_kitchen",
    "open_kitchen",  # the environment name; that of a registered layout is its name
    ("WW0WWWW", "W     W", "W APA B", "W     W", "WW1RXWW"),
    recipes=((0, 0, 1), (0, 1, 1)),
)
