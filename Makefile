# `make run` and `make test` set everything up on a machine that has Python 3.11+ and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: run test check unit setup clean

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("cofix needs Python 3.11 or newer: make PYTHON=python3.11") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -qq --upgrade 'pip>=24'
	$(BIN)/python -W ignore -m pip install -qq --editable '.[dev]'
	touch $@

setup: $(STAMP)

run: setup
	$(BIN)/cofix run

test: check unit

check: setup
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/mypy --strict examples

unit: setup
	$(BIN)/python -P -m pytest tests

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
