"""Writing of releases, and conversion between the formats of releases and of other files."""
