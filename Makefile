# ldrl needs python3 (3.11 or newer) and make. Every target sets .venv up first if needed.
#   make train ARGS="preset=smoke"     arguments for the recipe
#   make test  ARGS="-k towns"         arguments for pytest
#   make setup PYTHON=python3.12       another interpreter, for a new .venv

SHELL := bash
.DEFAULT_GOAL := help

PYTHON ?= python3
ARGS ?=

VENV := .venv
STAMP := $(VENV)/.installed
RUN := $(VENV)/bin/python

# glibc keeps what is freed, instead of asking the system for the memory of every batch anew.
export MALLOC_MMAP_MAX_ ?= 0
export MALLOC_TRIM_THRESHOLD_ ?= 4611686018427387904

.PHONY: help setup train test lint

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1	\2/p' Makefile

setup: $(STAMP) ## make .venv with ldrl and the tested versions of everything it needs

train: setup ## collect, train and evaluate the default agent; results go to runs/
	$(RUN) recipes/bc_hierarchical.py $(ARGS)

test: setup ## run the tests and the doctests
	OMP_NUM_THREADS=1 $(RUN) -m pytest -n auto --maxprocesses 4 $(ARGS)

lint: setup ## ruff check, ruff format --check, mypy
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy

# Runs again whenever the requirements change. A .venv that lacks a working pip (a moved interpreter,
# an interrupted set-up) is made afresh. pip's own settings (PIP_INDEX_URL and the like) are honoured.
# On a terminal the loop keeps one status line; in a log it prints one line per large step.
$(STAMP): pyproject.toml constraints.txt
	@$(RUN) -m pip --version >/dev/null 2>&1 || { \
		$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
			echo "$(PYTHON) is not Python 3.11 or newer; name one that is: make setup PYTHON=python3.12" >&2; exit 1; }; \
		echo "Making $(VENV) with $$($(PYTHON) --version)"; \
		$(PYTHON) -m venv --clear $(VENV) || { \
			echo "$(PYTHON) cannot make a virtual environment; on Debian and Ubuntu install python3-venv" >&2; exit 1; }; }
	@echo "Installing ldrl and the versions in constraints.txt (torch is the large one; minutes the first time)"
	@set -o pipefail; start=$$SECONDS; \
	if [ -t 1 ]; then line='\r\033[K  %s'; end='\r\033[K'; else line='  %s\n'; end=''; fi; \
	$(RUN) -m pip install --disable-pip-version-check --progress-bar off -c constraints.txt -e ".[dev,ps]" \
	| while read -r step what rest; do \
		case $$step in \
			Downloading) printf "$$line" "downloading $$what $$rest" ;; \
			Installing) if [ "$$what" = collected ]; then printf "$$line" "unpacking"; fi ;; \
		esac; \
	done || { echo "Set-up failed: see pip's error above; make setup tries again" >&2; exit 1; }; \
	printf "$$end"; \
	touch $@; \
	echo "Ready in $$((SECONDS - start)) s: $(VENV)"
