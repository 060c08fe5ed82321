VENV ?= .venv
PYTHON ?= python3
CONSTRAINTS ?= constraints.txt
OUT ?= out
export TENSOR_STEREO_DATA ?= $(abspath ../shared/data)

BIN := $(VENV)/bin
READY := $(VENV)/.ready
# One worker per core, one thread each.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto

.DEFAULT_GOAL := help
.PHONY: help dev demo test check format lint types imports slow notebooks hooks clean

help:  ## Show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

dev: $(READY)  ## Build the environment in .venv (a torch that is there already stays)

$(READY): pyproject.toml $(CONSTRAINTS) $(wildcard kernels/*.* kernels/*/*.* kernels/*/*/*.*)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) --editable '.[dev,notebooks]'
	touch $@

demo: $(READY)  ## Classify the embedded synthetic set with all detectors; tables and figures go to out/demo
	$(BIN)/tensor-stereo demo --out $(OUT)/demo

test: $(READY)  ## Run the default suite
	$(PYTEST)

check: format lint types imports test slow  ## All that CI runs

format: $(READY)  ## Check the formatting
	$(BIN)/ruff format --check .

lint: $(READY)  ## Check style and docstrings
	$(BIN)/ruff check .

types: $(READY)  ## Check the types
	$(BIN)/mypy

imports: $(READY)  ## Check the import rules of the package
	$(BIN)/lint-imports --no-logo --no-cache

slow: $(READY)  ## Run the tests marked slow, cluster, browser or notebook
	$(PYTEST) -m 'slow or cluster or browser or notebook'

hooks: $(READY)  ## Install the git hooks
	$(BIN)/pre-commit install

clean:  ## Remove the environment, caches and results
	rm -rf $(VENV) $(OUT) build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
