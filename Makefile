# `make run` and `make test` set everything up on a machine that has Python 3.11+ and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: run test check unit setup benchmark check-data check-fuzz check-long check-matrix clean

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
	$(BIN)/ruff check --no-cache .
	$(BIN)/mypy
	$(BIN)/mypy --strict examples
	$(BIN)/mypy benchmarks

# Processes and links of real time come after the rest. They wait more than they work, so two at a time.
unit: setup
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -P -m pytest -n 2 --dist loadfile -m "not realtime" tests
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -P -m pytest -n 2 --dist loadfile -m realtime tests/deploy tests/docs tests/examples

# Ratios against public libraries, speed of fleets, memory; measured, never asserted by tests.
benchmark: setup
	$(BIN)/python -m pip install -qq --editable '.[benchmarks]'
	$(BIN)/python -m benchmarks

# Everything a peer can send, in millions, with a table of what became of it. Goes on where it stopped.
check-fuzz: setup
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.fuzz --out runs/check-fuzz

# Thousands of seeds of random faults, invariants checked after every event. Results are kept in runs/check-long, and the same
# command goes on where it stopped.
check-long: setup check-fuzz check-matrix
	COFIX_THOROUGH=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -P -m pytest -n 2 tests/agent tests/sim tests/network
	COFIX_THOROUGH=1 $(BIN)/python -P -m pytest tests/deploy/test_process_fleet.py tests/docs
	COFIX_INTERLEAVING_DEPTH=4 $(BIN)/python -P -m pytest -s tests/agent/test_three_robots.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/cofix montecarlo fault-plan --trials 2000 --check --out runs/check-long/field
	OPENBLAS_NUM_THREADS=1 $(BIN)/cofix montecarlo fault-plan --trials 500 --check --set fault_plan.intensity=storm --out runs/check-long/storm

# Faults of real processes one by one (killed, paused, cut off, twice there, disks full, sessions lost), and agents in network
# namespaces, where root and `ip` are; a quarter of an hour. -s: durations of reconnections are told.
check-matrix: setup
	COFIX_MATRIX=1 $(BIN)/python -P -m pytest -s --durations=0 tests/deploy/test_fault_matrix.py tests/deploy/test_namespaces.py

# make check-data UTIAS7=FOLDER [TIERS=FOLDER] [DRONES=FOLDER]: the tests on recorded data, which is not part of the repository.
check-data: setup
	@test -n "$(UTIAS7)$(TIERS)$(DRONES)" || { echo "check-data: give UTIAS7=FOLDER of MRCLAM_Dataset7, TIERS=FOLDER of the UWB bags, or DRONES=FOLDER, dataset3 of the drone tracking set"; exit 2; }
	COFIX_UTIAS7="$(UTIAS7)" COFIX_TIERS="$(TIERS)" COFIX_DRONES="$(DRONES)" $(BIN)/python -P -m pytest tests/sim/test_utias.py tests/sim/test_utias_acceptance.py tests/deploy/test_utias_processes.py tests/sim/test_tiers.py tests/sim/test_drone_cameras.py

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
