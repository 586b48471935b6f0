"""Command line of `icrl4aht-data`."""
