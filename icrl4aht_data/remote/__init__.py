"""Releases at an address: byte ranges, partially downloaded files, downloads."""
