"""Web page of `icrl4aht-data play`, on which one or two people play, and the recording of their games."""
