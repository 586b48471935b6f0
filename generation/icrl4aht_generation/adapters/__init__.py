"""The environment for other libraries: Gymnasium, PettingZoo and JaxMARL."""
