"""HTML pages of `icrl4aht-data browse`, which show histories in a web browser."""
