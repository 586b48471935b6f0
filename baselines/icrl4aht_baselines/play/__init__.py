"""A page on which one or two people play, `icrl4aht-data play`, and the recording of what they play."""
