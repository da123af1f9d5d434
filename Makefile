# One command each: make demo | test | check | bench | train. Everything lives in .venv; PYTHON chooses the interpreter.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt
WORKERS ?= 2

.PHONY: demo test campaign check format bench train wheel integrate clean

demo: $(VENV)/.base
	$(BIN)/warploom demo

test: $(VENV)/.dev
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

# The long versions of tests: kills by the hundred, soaks, ten thousand starts and stops.
campaign: $(VENV)/.dev
	$(BIN)/python -m pytest -m campaign

check: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/python -m pytest -q tests/test_import_rules.py

format: $(VENV)/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(VENV)/.bench
	$(BIN)/python -m warploom.bench --out docs/benchmarks.md

# Reproduces the shipped detection head; hours on two cores, see models/training/.
train: $(VENV)/.dev
	$(BIN)/python -m warploom.models.training --seed 0 --out training-run

wheel: $(VENV)/.dev
	$(BIN)/python -m build --wheel --no-isolation --outdir dist .

# A folder from which OUT/bin/start_all runs the node without the checkout.
integrate: $(VENV)/.base
	@test -n "$(OUT)" || { echo "make integrate OUT=DIR"; exit 2; }
	$(BIN)/python -m warploom.components.integration $(OUT)

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.base: $(BIN)/python pyproject.toml constraints.txt
	$(PIP) -e .
	touch $@

$(VENV)/.dev: $(VENV)/.base
	$(PIP) -e .[dev]
	touch $@

$(VENV)/.bench: $(VENV)/.dev
	$(PIP) -e .[bench]
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
