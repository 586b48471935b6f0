"""Writing of releases, and conversion of releases to and from other file formats."""
