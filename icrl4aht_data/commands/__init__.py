"""The `icrl4aht-data` command line."""
