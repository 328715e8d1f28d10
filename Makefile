# make book    the book as HTML: _build/html/index.html
# make test    everything that must hold before a change is kept
# make lab     JupyterLab on the notebooks
# make notebooks   execute all notebooks again, in place
# make clean   remove what was built; the environment too
#
# Needs Python 3.11 or later with pip, and make. Everything else is installed
# into .venv, once, and again only when requirements.txt or pyproject.toml change.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:
.DELETE_ON_ERROR:
.DEFAULT_GOAL := book

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
LAB_STAMP := $(VENV)/.installed-lab
HTML := _build/html

# The first interpreter on the PATH that is recent enough; `make PYTHON=... book` overrides.
RECENT := import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for p in python3.11 python3 python; do \
	if $$p -c '$(RECENT)' >/dev/null 2>&1; then echo $$p; break; fi; done)

export JAX_PLATFORMS ?= cpu
export PYTHONDONTWRITEBYTECODE :=
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help book test lab notebooks clean lint types unit nbval html html-strict test-html

help:
	@sed -n 's/^# \{0,1\}//p' Makefile | sed -n '1,8p'

$(STAMP): requirements.txt pyproject.toml
	@if [ -z "$(PYTHON)" ] || ! "$(PYTHON)" -c '$(RECENT)' >/dev/null 2>&1; then
		echo "error: Python 3.11 or later was not found; name it with 'make PYTHON=/path/to/python ...'" >&2
		exit 1
	fi
	rm -f $(STAMP) $(LAB_STAMP)
	[ -x $(BIN)/python ] || "$(PYTHON)" -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -r requirements.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $(STAMP)

$(LAB_STAMP): $(STAMP)
	@$(BIN)/python -m pip install --quiet -c requirements.txt jupyterlab
	touch $(LAB_STAMP)
