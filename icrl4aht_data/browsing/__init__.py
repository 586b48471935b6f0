"""HTML pages that show learning histories in a web browser, written by `icrl4aht-data browse`."""
