# Two commands are all the set-up there is: `make repro` and `make test`.
#
#   make repro PRESET=tiny      the whole pipeline in a temporary copy, in minutes
#   make docs                   the site, built offline: reports/site/index.html
#   make tutorials              the notebooks, executed: reports/notebooks/*.html
#   make bench D3RLPY=PYTHON     speed of agents and model; a Python that has d3rlpy gives the ratios with it
#   make … TORCH_INDEX=URL      another build of torch, such as https://download.pytorch.org/whl/cpu
#   make … CONSTRAINTS=FILE     other pinned versions (CONSTRAINTS= for the newest that pyproject.toml allows)
#   make … PYTHON=python3.12    another Python for a new .venv

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= python3
CONSTRAINTS ?= constraints.txt
TORCH_INDEX ?=
PRESET ?=

# DVC's stages look for `envtf` on PATH: .venv comes first, whatever is active.
export VIRTUAL_ENV := $(CURDIR)/.venv
export PATH := $(VIRTUAL_ENV)/bin:$(PATH)
unexport PYTHONHOME PYTHONPATH

# The lock holds the same versions as constraints.txt, with hashes: it goes with no other.
LOCK = $(if $(filter constraints.txt,$(CONSTRAINTS)),requirements.lock)
PIP = .venv/bin/python -m pip install --quiet --disable-pip-version-check
PINNED = $(PIP) $(if $(CONSTRAINTS),--constraint $(CONSTRAINTS)) $(if $(LOCK),--no-build-isolation)
TORCH = $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))

.PHONY: help repro tutorials test test-all docs bench lint lock clean

help:
	@sed -n 's/^# \{0,1\}//p' Makefile | head -9

repro: .venv/.installed .dvc/tmp/.ready
ifeq ($(PRESET),)
	dvc repro
	@echo "Done: reports/report.html and reports/metrics.json"
else
	@copy=$$(mktemp -d -t envtf-$(PRESET)-XXXXXX); \
	  envtf init "$$copy" --preset $(PRESET); \
	  cd "$$copy"; dvc repro; \
	  echo "Done: $$copy/reports/report.html (the copy is yours to keep or delete)"
endif

# Those whose notebook or package did not change since are not executed again, but for that on the comparison's results.
tutorials: .venv/.installed-dev .dvc/tmp/.ready
	dvc repro notebooks/dvc.yaml
	@echo "Done: reports/notebooks"

test: .venv/.installed-dev
	pytest -q -n auto

test-all: .venv/.installed-dev
	pytest -q -n auto -m "slow or not slow"

docs: .venv/.installed-docs
	sphinx-build --quiet --fail-on-warning --keep-going --doctree-dir .envtf/doctrees docs reports/site
	@echo "Done: reports/site/index.html"

bench: .venv/.installed-dev
	envtf bench agents $(if $(D3RLPY),--d3rlpy $(D3RLPY)) --out reports/bench/agents.json
	envtf bench model --out reports/bench/model.json

lint: .venv/.installed-dev
	ruff format --check .
	ruff check .
	pyright
	lint-imports

clean:
	rm -rf .envtf build dist .pytest_cache .ruff_cache

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "make: Python 3.11 or newer is needed, and $(PYTHON) is $$($(PYTHON) --version 2>/dev/null || echo missing): give another, such as make PYTHON=python3.12." >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "make: $(PYTHON) lacks venv or ensurepip: install them (on Debian and Ubuntu: apt install python3-venv)." >&2; exit 1; }
	@$(PYTHON) -m venv .venv

.venv/.installed: .venv/bin/python pyproject.toml $(CONSTRAINTS) $(LOCK)
	@echo "Installing into .venv (a few minutes the first time) …"
	@$(if $(LOCK),$(PIP) --require-hashes --no-deps --requirement $(LOCK))
	@$(PINNED) $(TORCH) --editable '.[pipeline]'
	@touch $@

.venv/.installed-dev: .venv/.installed
	@$(PINNED) $(TORCH) --editable '.[dev]'
	@touch $@

.venv/.installed-docs: .venv/.installed
	@$(PINNED) $(TORCH) --editable '.[docs]'
	@touch $@

# Written anew after any change of constraints.txt or of the dependencies. Torch is left out with all that its builds
# bring along; hatchling and editables build this package.
lock: .venv/bin/python
	@$(PINNED) uv
	@trap 'rm -f requirements.lock.new' EXIT; \
	  { sed '/^[^#]/,$$d' requirements.lock; \
	  printf 'hatchling\neditables\n' | uv pip compile --quiet --universal --generate-hashes --no-header --no-annotate \
	    --python-version 3.11.5 --constraint constraints.txt --extra pipeline pyproject.toml - | \
	  awk '/^[^ ]/ { left_out = /^(torch|triton|cuda-[a-z]+|nvidia-[a-z0-9-]+)==/ } !left_out'; } >requirements.lock.new; \
	  mv requirements.lock.new requirements.lock

# A download without .git has no SCM for DVC to use.
.dvc/tmp/.ready: .venv/.installed
	@mkdir -p .dvc/tmp
	@git rev-parse --git-dir >/dev/null 2>&1 || dvc config --local core.no_scm true
	@touch $@
