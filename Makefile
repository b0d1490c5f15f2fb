# Two commands for a newcomer: `make demo` and `make test`. Both are idempotent and need no root.
# PyBullet has wheels for Python 3.10 and 3.11 on Linux x86-64; PYTHON=... names another interpreter.
VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= $(shell for name in python3.11 python3.10 python3 python; do \
	"$$name" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 11))' 2>/dev/null && { echo "$$name"; break; }; done)
DEMO_EPISODES ?= 100
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test check bench torture clean

demo: $(VENV)/.installed  ## train method C for a short budget, test it on the 100 positions, write the report
	$(BIN)/uarm-rl train experiment=C episodes=$(DEMO_EPISODES) results_dir=demo resume=true
	$(BIN)/uarm-rl evaluate results_dir=demo
	[ -f demo/ik/seed0/evaluation.csv ] || $(BIN)/uarm-rl evaluate policy=ik results_dir=demo
	[ -f demo/adaptive-penalty/seed0/episode.gif ] || $(BIN)/uarm-rl render run=demo/adaptive-penalty/seed0
	$(BIN)/uarm-rl report results_dir=demo

test: $(VENV)/.installed-test  ## the whole test suite
	$(BIN)/python -m pytest -n 2

check: $(VENV)/.installed-dev  ## formatting, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: $(VENV)/.installed-bench  ## speed, as ratios measured side by side; about 10 minutes
	$(BIN)/python benchmarks/bench.py

torture: $(VENV)/.installed-test  ## kill trainings, fail saves, damage files; about 10 minutes
	$(BIN)/python -m tests.torture --out tests/torture.csv

$(VENV)/bin/python:
	@[ -n "$(PYTHON)" ] || { echo "uarm-rl needs Python 3.10 or 3.11 (PyBullet has no wheels for others): install one, or name it with PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)

# The stamps go stale when what is installed changes; the editable install follows the code by itself.
$(VENV)/.installed: $(VENV)/bin/python setup.cfg pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	@touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed-test
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

$(VENV)/.installed-bench: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	@touch $@

clean:
	rm -rf $(VENV) build demo *.egg-info
