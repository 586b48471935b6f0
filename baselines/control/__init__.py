"""The positive control: worlds in which the models must adapt in context."""
