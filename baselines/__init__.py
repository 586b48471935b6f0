"""Reference agents and the one evaluator of the benchmark."""
