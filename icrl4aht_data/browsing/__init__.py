"""The page `icrl4aht-data browse`: histories to look at in a web browser."""
