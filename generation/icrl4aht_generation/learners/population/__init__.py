"""Population training: FCP, BRDiv, LBRDiv and CoMeDi."""
