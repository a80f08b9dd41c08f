# make demo: a co-simulation of a street with traffic, with pictures. make test: every check.
# What make demo needs is a part of what make setup installs: ray tracer, SUMO and Matplotlib.
BIN      := .venv/bin
STAMP    := .venv/.setup-done
DEMO     := .venv/.setup-demo
SCENARIO ?= demo
FRAMES   ?= 120
TESTS    ?= tests
WORKERS  ?= 3

# The tests start some two thousand processes; without bytecode on the disk each compiles 80 modules: 0.2 s of CPU.
unexport PYTHONDONTWRITEBYTECODE
# WORKERS share the cores already: threads of BLAS and PyTorch that wait for each other take longer than one.
test test-all check: export OMP_NUM_THREADS := 1
test test-all check: export OPENBLAS_NUM_THREADS := 1

# A .venv of another Python than the one that is asked for with PYTHON=… is made again.
ifeq ($(origin PYTHON),command line)
ifneq ($(shell $(BIN)/python --version 2>/dev/null),$(shell $(PYTHON) --version 2>/dev/null))
$(STAMP) $(DEMO): another-python
endif
endif

.DEFAULT_GOAL := help
.PHONY: help setup demo check test test-all lint docs doctor clean another-python

help: ## List these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(STAMP) ## Make .venv (PYTHON=python3.13 chooses of which) and see to the system libraries
	@:

$(STAMP): pyproject.toml deploy/setup.sh
	@deploy/setup.sh dev

$(DEMO): pyproject.toml deploy/setup.sh
	@deploy/setup.sh demo

demo: $(if $(wildcard $(STAMP)),$(STAMP),$(DEMO)) ## Run SCENARIO for FRAMES frames, draw its pictures, say where they are
	@FRAMES=$(FRAMES) deploy/demo.sh $(SCENARIO)

lint: setup ## Style, types and the imports that the architecture allows
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

check: lint ## Lint, and the unit tests that are quick
	@$(BIN)/pytest --quiet --numprocesses=2 --dist=loadfile -m "not slow" tests/unit tests/vectors

test: lint ## Everything that CI checks; TESTS=tests/unit runs a part, in WORKERS processes
	@$(BIN)/pytest --numprocesses=$(WORKERS) --dist=loadfile --no-loadscope-reorder --durations=10 $(TESTS)

test-all: lint ## The same and the long forms: the documentation, a million fuzzed inputs, the whole fault matrix, containers
	@if docker info >/dev/null 2>&1 && command -v docker-compose >/dev/null; then \
	  (cd deploy && docker-compose build --quiet) || echo "the images of deploy/ were not built"; fi
	@$(BIN)/pytest --all --numprocesses=$(WORKERS) --dist=loadfile --no-loadscope-reorder --durations=20 $(TESTS)

# The environment of the tests has what documentation needs; where there is none, one without PyTorch is made.
DOCS     := $(if $(wildcard $(STAMP)),$(BIN),.venvs/docs/bin)

.venvs/docs/bin/sphinx-build: pyproject.toml
	@$(if $(wildcard $(BIN)/python),$(BIN)/python,$(or $(PYTHON),python3)) -m venv .venvs/docs
	@.venvs/docs/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $@

docs: $(DOCS)/sphinx-build ## Render the documentation; build/docs/index.html opens without a server
	@$(DOCS)/sphinx-build --quiet --fail-on-warning --keep-going -c docs . build/docs
	@echo "build/docs/index.html"

doctor: setup ## What this machine has, and what mends what it lacks
	@$(BIN)/caviar doctor

clean: ## Remove .venv, caches and builds; recorded runs stay
	@cd docs/reference && rm -rf api commands frame-path scenario
	@rm -rf .venv .venvs build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	@find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +
