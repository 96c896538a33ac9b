# Two commands: `make train` trains and evaluates an agent, `make test` checks everything.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
ARGS ?=

export JAX_PLATFORMS ?= cpu

.PHONY: help setup train test medium slow sb3 peers parity lint bench docs clean

help:
	@echo "make train   train an agent, compare it with the baselines, draw pictures (runs/)"
	@echo "make test    lint, types and all quick tests"
	@echo "make medium  the tests that take a little longer, which CI runs, too"
	@echo "make slow    the tests that take minutes"
	@echo "make sb3     the tests that need Stable-Baselines3, which it installs (with torch, 1 GB)"
	@echo "make peers   the comparison with FilterPy, which it installs"
	@echo "make parity  the parity table of the README, in full"
	@echo "make lint    ruff and mypy only"
	@echo "make bench   speeds beside Stone Soup's and FilterPy's in ten minutes (bench/)"
	@echo "make docs    the site of the documentation (build/docs)"
	@echo "make setup   .venv with everything the above need"
	@echo "ARGS=... is handed on, for example: make train ARGS='--encoder mhsa --seed 1'"

setup: $(STAMP)

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed: make PYTHON=python3.11 ..." if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --editable ".[reference,dev]"
	@touch $(STAMP)

train: setup
	@started=$$(date +%s); $(BIN)/python -m train.ppo $(ARGS) && \
	echo "make train took $$(( $$(date +%s) - started )) s"

test: setup
	@started=$$(date +%s); $(MAKE) --no-print-directory lint && $(BIN)/pytest -n auto --dist loadfile $(ARGS) && \
	echo "make test took $$(( $$(date +%s) - started )) s"

medium: setup
	$(BIN)/pytest -m medium -n auto --dist loadfile $(ARGS)

slow: setup
	$(BIN)/pytest -m slow $(ARGS)

sb3: setup
	$(BIN)/pip install --quiet --editable ".[sb3]"
	$(BIN)/pytest -m sb3 $(ARGS)

peers: setup
	$(BIN)/pip install --quiet --editable ".[bench]"
	$(BIN)/pytest tests/test_tracker_benchmark.py $(ARGS)

parity: setup
	$(BIN)/python -m reference.parity --out docs/parity.json --readme README.md $(ARGS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: setup
	$(BIN)/pip install --quiet --editable ".[bench]"
	@started=$$(date +%s); $(BIN)/python -m benchmarks $(ARGS) && \
	echo "make bench took $$(( $$(date +%s) - started )) s"

docs: setup
	$(BIN)/pip install --quiet --editable ".[docs]"
	$(BIN)/sphinx-build --quiet --fail-on-warning --fresh-env -c docs . build/docs
	@echo "build/docs/docs/index.html"

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
