# make train: installs if need be and runs the main job.  make test: the same set-up, then the quick test suite.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: setup train test test-slow chaos peers lint clean
.DEFAULT_GOAL := train

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

train: setup
	$(BIN)/apex-bat train --config configs/memory.toml

test: setup
	$(BIN)/pytest -n 2

test-slow: setup
	$(BIN)/pytest -m slow --timeout 900

# Ten minutes of training whose roles are killed and stopped all the while: what it costs and loses.
chaos: setup
	$(BIN)/python -m benchmarks.chaos

# A virtual environment for each library of `python -m benchmarks.peers`: they need versions that exclude one another.
peers: setup .peers/tianshou/.installed .peers/sb3/.installed .peers/rllib/.installed

.peers/%/.installed: benchmarks/peers/requirements-%.txt
	$(PYTHON) -m venv .peers/$*
	.peers/$*/bin/pip install --quiet --disable-pip-version-check --no-deps --requirement $<
	@touch $@

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) .peers build *.egg-info .mypy_cache .ruff_cache .pytest_cache
