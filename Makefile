# `make demo` and `make test` need nothing but Python 3.11+ and a package registry.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
THREADS := OMP_NUM_THREADS=1

.PHONY: setup demo test test-all lint bench figures clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet -c constraints.txt torch
	$(BIN)/python -m pip install --quiet -c constraints.txt --editable . --group dev
	touch $(STAMP)

demo: setup
	$(BIN)/weather-aug demo --out out/demo

test: setup
	$(BIN)/python -m pytest

test-all: setup
	$(BIN)/python -m pytest -m "slow or not slow"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: setup
	$(THREADS) NUMBA_NUM_THREADS=1 NO_ALBUMENTATIONS_UPDATE=1 $(BIN)/python -m benchmarks.run
	NO_ALBUMENTATIONS_UPDATE=1 $(BIN)/python -m benchmarks.readme_table

figures: setup
	$(BIN)/python recipes/02_physics_figures.py --out docs/figures

clean:
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache
