# `make demo` and `make test` set everything up by themselves; `make help` lists the rest.
# They need Python 3.12 with pip, make, and on Debian or Ubuntu root (or sudo) for three OpenGL packages and FFmpeg.

ifndef PYTHON
# The first Python 3.12 that has pip: that of an active virtual environment may have none.
PYTHON := $(shell for python in $$(which -a python3.12 python3); do \
  $$python -c 'import pip, sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null && echo $$python && break; done)
endif
UV := .uv/bin/uv
RUN := $(UV) run --frozen

.PHONY: help setup system demo test check format type lint bench wheels clean

help: ## List the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

$(UV):
	@test -n "$(PYTHON)" || \
	  { echo "No Python 3.12 with pip was found. Try: make $(MAKECMDGOALS) PYTHON=/path/to/python3.12"; exit 1; }
	$(PYTHON) -m pip install --quiet --disable-pip-version-check --target .uv 'uv>=0.8,<1'

setup: system $(UV) ## Install the system packages and the locked Python environment
	@# What was added to it since stays.
	$(UV) sync --frozen --inexact --compile-bytecode --python $(PYTHON)

system: ## Install EGL, software OpenGL, and FFmpeg to read videos
	@sh .ci/system-packages

demo: setup ## Learn with a reset for every fourth task, evaluate before and after, report: 4 minutes on 2 cores
	$(RUN) cronos-demo

test: setup ## Run the whole test suite, one worker a core
	@sh .ci/system-packages tests
	OMP_NUM_THREADS=1 $(RUN) pytest -n auto --dist loadfile --no-loadscope-reorder --durations=40 --durations-min=5

check: lint type ## What CI checks besides the tests

lint:
	$(RUN) ruff check .
	$(RUN) ruff format --check .

type:
	$(RUN) ty check cronos_lerobot envs policies

format: ## Format and fix
	$(RUN) ruff format .
	$(RUN) ruff check --fix .

bench: setup ## Steps per second of physics, pixels and training, as ratios
	$(RUN) python benchmarks/speed.py

wheels: $(UV) ## Build the wheels into dist/
	$(UV) build --all-packages --wheel

clean: ## Remove the environment and build outputs
	rm -rf .venv .uv dist
