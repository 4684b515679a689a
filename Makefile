# Needs make and Python 3.11 or newer. Everything else goes into .venv, from requirements.lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.stamp

PYTEST_ARGS ?=
DEMO_ARGS ?= --planners drnav,dwa --world u:0 --out results/demo
BENCH_ARGS ?=
LOCK_ARGS ?=

# pyright ships with its wheel; do not let it ask the package index for a newer one.
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-long test-all lint bench lock clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 12

setup: $(STAMP)  ## create .venv with the locked packages and this one, editable

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and "Python 3.11 or newer is needed, $(PYTHON) is %d.%d: make PYTHON=/path/to/python3.11" % v[:2])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	@touch $@

demo: $(STAMP)  ## one trap, with and without dead-end prediction
	$(BIN)/drnav compare $(DEMO_ARGS)

test: $(STAMP)  ## the tests, but for the long and the slow ones
	$(BIN)/python -m pytest -q -m "not slow and not long" -n 2 --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

test-long: $(STAMP)  ## those that `make test` leaves out for its length
	$(BIN)/python -m pytest -q -m "long and not slow" -n 2 $(PYTEST_ARGS)

test-all: $(STAMP)  ## every test, as users compile it
	XLA_FLAGS="$(XLA_FLAGS)" $(BIN)/python -m pytest -q $(PYTEST_ARGS)

lint: $(STAMP)  ## ruff and pyright; layout is by hand (comments in columns), so no format check
	$(BIN)/ruff check .
	$(BIN)/pyright

bench: $(STAMP)  ## times of the parts, next to a fixed matmul
	$(BIN)/drnav bench $(BENCH_ARGS)

# One version of each package for every Python (fewest), or the lock would hold a jax that nobody tested.
# Pins already in the lock stay; LOCK_ARGS=--upgrade moves them, LOCK_ARGS="--upgrade-package jax" one.
lock: $(STAMP)  ## resolve requirements.lock anew
	$(BIN)/uv pip compile pyproject.toml --extra train --extra viz --extra test --extra dev \
		--universal --python-version 3.11 --fork-strategy fewest \
		--generate-hashes --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" \
		--quiet --output-file requirements.lock $(LOCK_ARGS)

clean:  ## caches and results, not the environment
	rm -rf .jax_cache .pytest_cache .ruff_cache .hypothesis results build dist
