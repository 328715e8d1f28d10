# make book    the book as HTML: _build/html/index.html
# make test    everything that must hold before a change is kept
# make quick   lint, types and a few fast tests of every module, in a minute
# make test-studies   more of each study's first draw again than `make test` does
# make test-lab   the widget that asks, in a real JupyterLab: needs a Chromium, takes a minute
# make lab     JupyterLab on the notebooks
# make notebooks   execute all notebooks again, in place
# make bench   the times of the library beside its peers', in 8 minutes
# make clean   remove what was built; the environment too
#
# Needs Python 3.11 or later with pip, and make. Everything else is installed
# into .venv, once, and again only when requirements.txt or pyproject.toml change.

.DEFAULT_GOAL := book

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
LAB_STAMP := $(VENV)/.installed-lab
HTML := _build/html
PYTEST := $(BIN)/python -m pytest -q
# A fast test file of each part of the library; `malformed_inputs` calls everything public.
QUICK := systems trajectories preferences comparisons pools models loss minimise plots files \
	malformed_inputs interview convex_mpc terminal package notebooks spread_files

# The first interpreter on the PATH that is recent enough; `make PYTHON=... book` overrides.
RECENT := import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for p in python3.11 python3 python; do \
	if $$p -c '$(RECENT)' >/dev/null 2>&1; then echo $$p; break; fi; done)

export JAX_PLATFORMS ?= cpu
# The matrices are small: threads would only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Dozens of processes import the same modules: each is compiled once, whatever the shell says.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help book test quick test-studies test-lab lab notebooks bench clean lint types unit nbval unit-and-nbval html html-strict test-html

help:
	@sed -n 's/^# \{0,1\}//p' Makefile | sed -n '1,12p'

# The list is complete, so nothing has to be resolved. The last line but one compiles what all
# notebooks import (pip would compile everything), and builds matplotlib's font cache, which would
# else write a message into the first notebook that draws.
$(STAMP): requirements.txt pyproject.toml book/pyproject.toml
	@if [ -z "$(PYTHON)" ] || ! "$(PYTHON)" -c '$(RECENT)' >/dev/null 2>&1; then \
		echo "error: Python 3.11 or later was not found; name it: make PYTHON=/path/to/python" >&2; \
		exit 1; \
	fi
	@echo "Installing into $(VENV); this takes a minute or two."
	@rm -f $(STAMP) $(LAB_STAMP)
	@[ -x $(BIN)/python ] || "$(PYTHON)" -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --no-deps --no-compile -r requirements.txt
	@$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e . -e book
	@$(BIN)/python -m pip check --quiet
	@$(BIN)/python -W ignore -c 'import cvxpy, ipykernel.ipkernel, matplotlib.pyplot, studies' \
		2>/dev/null
	@touch $(STAMP)

$(LAB_STAMP): $(STAMP)
	@echo "Installing JupyterLab into $(VENV)."
	@$(BIN)/python -m pip install --quiet -c requirements.txt jupyterlab
	@touch $(LAB_STAMP)

# ---- the book ----

book: html
	@echo "The book is at $(HTML)/index.html"

html: $(STAMP)
	@$(BIN)/jupyter-book build --quiet .

notebooks: $(STAMP)
	@$(BIN)/python scripts/execute_notebooks.py

lab: $(LAB_STAMP)
	@$(BIN)/jupyter lab --notebook-dir=book

bench: $(STAMP)
	@$(BIN)/python -W ignore benchmarks/run.py

# ---- the checks ----

# In this order: the quick ones first.
test: $(STAMP)
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target lint types html-strict
	@$(MAKE) --no-print-directory test-html unit-and-nbval
	@echo "All checks passed: lint, types, unit tests, notebooks, HTML."

quick: $(STAMP)
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target lint types
	@$(PYTEST) $(QUICK:%=tests/test_%.py)

test-studies: $(STAMP)
	@PREFMPC_STUDIES=all $(PYTEST) $(wildcard tests/test_*_study.py tests/test_*_studies.py)

test-lab: $(LAB_STAMP)
	@PREFMPC_LAB=1 $(PYTEST) -n 0 tests/html/test_lab.py

lint: $(STAMP)
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --check --quiet --exclude '*.ipynb' .

types: $(STAMP)
	@$(BIN)/mypy --no-error-summary

unit: $(STAMP)
	@$(PYTEST)

# Both in one run, so that no worker waits for the other at the end of the first.
unit-and-nbval: $(STAMP)
	@$(PYTEST) --nbval book/ tests/

nbval: $(STAMP)
	@$(PYTEST) --nbval book/

# From scratch: an incremental build does not repeat the warnings of unchanged pages.
html-strict: $(STAMP)
	@rm -rf _build
	@$(BIN)/jupyter-book build --quiet . -W -n --keep-going

test-html: $(STAMP)
	@$(PYTEST) -n 0 tests/html

clean:
	@rm -rf $(VENV) _build build dist ./*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
