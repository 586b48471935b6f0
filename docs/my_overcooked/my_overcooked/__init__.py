"""A layout, a teammate and a method of another package, see docs/extending.md."""
