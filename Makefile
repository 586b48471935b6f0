# `make help` lists everything. Targets need only Python 3.11+, make and git; they make their own .venv.
PYTHON ?= python3
PROFILE ?= smoke
OUT ?= build/$(PROFILE)
ROOT ?=
PEER ?=
OPTIONS ?=
WORKERS ?= 2

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
CODE := icrl4aht_data generation baselines benchmarks tests

.PHONY: help install demo generate teammates verify control test check format bench-env bench-eval bench-learner bench-collect bench-loader bench-remote bench-faults bench-train clean
.DEFAULT_GOAL := help

help: ## list the targets
	@awk -F':.*## ' '/^[a-z-]+:.*## /{printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(STAMP) ## make .venv and install the project into it, editable, with the dev extra

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, found %d.%d" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: install ## the whole way on the bundled release: load, sample, verify, train, evaluate, report (at most 10 minutes)
	$(BIN)/python -m baselines demo

generate: install ## rebuild a dataset, or go on with it: PROFILE=smoke|mini|paper, OUT=folder, OPTIONS=...
	$(BIN)/python -m generation generate --profile $(PROFILE) --out $(OUT) $(OPTIONS)

teammates: install ## train the suite of learned teammates: PROFILE=smoke|mini|paper
	$(BIN)/python -m generation teammates --profile $(PROFILE)

verify: install ## verify a release, every byte and the physics: ROOT=folder (default: the bundled mini release)
	$(BIN)/icrl4aht-data verify --deep $(ROOT)

control: install ## show that the models adapt in context where that is possible (about 10 minutes)
	$(BIN)/python -m baselines control

test: check ## lint, types and all tests: WORKERS=2 (3 GB each)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

check: install ## lint, formatting and types
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/basedpyright

format: install ## format the code and mend what the linter can
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/ruff format $(CODE)

bench-env: install ## environment steps/s beside JaxMARL's, JSON lines
	$(BIN)/python -m benchmarks.bench_env

bench-eval: install ## evaluation steps/s per teammate family beside the environment alone, JSON lines
	$(BIN)/python -m benchmarks.bench_eval

bench-loader: install ## batches/s of every way of holding data beside readers of the published format, JSON lines
	$(BIN)/python -m benchmarks.bench_loader

bench-learner: install ## self-play learning steps/s beside JaxMARL's IPPO: PEER=ippo_rnn_overcooked_v2.py of its repository
	$(BIN)/python -m benchmarks.bench_learner --peer $(PEER)

bench-remote: install ## requests, bytes and seconds of remote releases over HTTP, S3 and the Hub's protocol, JSON lines
	$(BIN)/python -m tests.robustness.bench_remote

bench-faults: install ## faults of remotes, disks, processes and files: tried, survived, lost, JSON lines
	$(BIN)/python -m tests.robustness.faults.series

bench-train: install ## training steps/s beside a reader of the published format, cached beside exact acting, JSON lines
	$(BIN)/python -m benchmarks.bench_train $(OPTIONS)

bench-collect: install ## collection: speed, memory, bytes a transition beside the paper's format, JSON lines
	$(BIN)/python -m benchmarks.bench_collect

clean: ## remove what the targets above made
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
