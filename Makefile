# `make help` lists the targets. They need Python 3.11+, make and git, and install the project into .venv.
PYTHON ?= python3
PROFILE ?= smoke
OUT ?= build/$(PROFILE)
ROOT ?=
PEER ?=
OPTIONS ?=
WORKERS ?= 2
# One more than the cores, because many slow tests wait for other processes and for downloads.
SLOW_WORKERS ?= 3

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
# Files keep their fixtures on one worker and start in order of collection: what compiles most comes first.
PYTEST = $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
CODE := icrl4aht_data generation baselines benchmarks tests docs/hooks.py

.PHONY: help install constraints demo generate teammates verify control test test-fast test-slow check docs format bench-env bench-collect bench-gpu bench-learn bench-loader clean
.DEFAULT_GOAL := help

help: ## list the targets
	@awk -F':.*## ' '/^[a-z-]+:.*## /{printf "  make %-13s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(STAMP) ## create .venv and install the project into it, editable, with the dev extra

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, found %d.%d" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

constraints: install ## write the versions in .venv into constraints.txt, once the tests have passed with them
	$(BIN)/python -m pip freeze --exclude-editable | sed 's/+cpu//' > constraints.txt

demo: install ## load, sample, verify, train, show what a model earns by its memory (at most 7 minutes)
	$(BIN)/icrl4aht-data demo

generate: install ## rebuild a release, or resume a rebuild: PROFILE=smoke|noise|search|bundle|teach|..., OUT=folder, OPTIONS=...
	$(BIN)/icrl4aht-data generate --profile $(PROFILE) --out $(OUT) $(OPTIONS)

teammates: install ## train the suite of learned teammates: PROFILE=smoke|small|mini|cpu|paper
	$(BIN)/icrl4aht-data teammates --profile $(PROFILE)

verify: install ## verify every byte and the physics of a release: ROOT=folder (default: the bundled mini release)
	$(BIN)/icrl4aht-data verify --deep $(ROOT)

control: install ## show that AD and DPT adapt in context in worlds built for it (about 10 minutes)
	$(BIN)/icrl4aht-data control

test: install ## lint, types and the default tests (5 minutes on 2 cores): WORKERS=2 (2 GB each)
	@$(MAKE) --no-print-directory --jobs=2 check test-fast

test-fast: install
	$(PYTEST) -m "not slow"

test-slow: install ## the slow tests: wheels, killed processes, Ray, several devices: SLOW_WORKERS=3 (2 GB each)
	$(PYTEST) -n $(SLOW_WORKERS) -m slow

docs: install ## build the documentation into build/docs; fails on broken links and names
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

check: install ## lint, formatting and types
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/basedpyright

format: install ## format the code and apply the linter's fixes
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/ruff format $(CODE)

bench-env: install ## steps/s of environments compared with JaxMARL's, JSON lines; PEER=its ippo_rnn_overcooked_v2.py learns in both
	$(BIN)/python -m benchmarks.bench_env $(if $(PEER),--peer $(PEER))

bench-loader: install ## windows/s of each cache compared with readers of the published format, JSON lines
	$(BIN)/python -m benchmarks.bench_loader

bench-learn: install ## speed of learning egos and of training and playing sequence models, JSON lines; PEER= as for bench-env
	$(BIN)/python -m benchmarks.bench_learn $(if $(PEER),--peer $(PEER)) $(OPTIONS)

bench-gpu: install ## learners, training, acting on a GPU in at most 9 minutes; tiny sizes on a CPU, JSON lines
	$(BIN)/python -m benchmarks.bench_gpu $(OPTIONS)

bench-collect: install ## collection: speed, memory, bytes a transition, compared with the paper's format, JSON lines
	$(BIN)/python -m benchmarks.bench_collect

clean: ## remove the outputs of the targets above
	rm -rf $(VENV) .cache build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
