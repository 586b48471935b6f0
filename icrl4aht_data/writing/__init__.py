"""Writing releases and converting between formats."""
