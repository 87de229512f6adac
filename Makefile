# make demo: sets up what is needed and renders the demonstration.
# make test: sets up what is needed and runs every test; make test TESTS=tests/io: the Python tests of one folder.
# make wheel: builds a wheel for the torch of VENV, and tries it in a fresh environment.
# make docs: builds the site of the documents in build/site.
# Set-up lives in a virtual environment, VENV. Nothing outside it is touched, except that on Debian as root
# missing build tools are installed with apt-get.

PYTHON ?= python3
VENV ?= .venv
MAKEFLAGS += --no-print-directory
# The torch to install where VENV has none. Any torch >= 2.4 will do: `make demo TORCH=torch==2.8.0`.
TORCH ?= torch==2.13.0
OUT ?= out
# How long make fuzz runs, s.
FUZZ_SECONDS ?= 600
# What make bench measures; by default the demo's target.
SCENE ?= $(OUT)/target.ply
VIEWS ?= $(OUT)/views.json
BUILD ?= build

BIN := $(VENV)/bin
JOBS := $(shell nproc 2>/dev/null || echo 2)
SOURCES := $(shell find csrc -name '*.h' -o -name '*.cpp' -o -name '*.cuh' -o -name '*.cu') setup.py pyproject.toml
CPP_SOURCES := $(shell git ls-files 'csrc/*' 'tests/cpp/*' 'simple_knn/csrc/*' 2>/dev/null)
# The system's cmake, or else one from PyPI.
CMAKE = $(shell command -v cmake || echo $(BIN)/cmake)

.PHONY: demo ready test build-tests build-cpp build-sanitized build-kernels-on-host build-simple-knn test-architectures \
  test-cpp test-python test-simple-knn test-browser test-sanitized test-sanitized-quick test-python-sanitized fuzz \
  fuzz-core bench wheel docs format lint clean

demo: $(VENV)/.installed
	$(BIN)/python examples/demo.py --out $(OUT)

# The C++ tests take the objects of the CPU path that the extension was linked from, where these are still there.
EXTENSION_OBJECTS = $(shell $(BIN)/python -c \
  'import pathlib, sys; print(*pathlib.Path.cwd().glob(f"build/temp-{sys.implementation.cache_tag}/csrc/cpu"))')
# TESTS=tests/io: the Python tests of a folder, and nothing else.
TESTS ?=
test: $(VENV)/.installed
ifeq ($(TESTS),)
	$(MAKE) test-cpp CORE_OBJECTS="$(EXTENSION_OBJECTS)"
	$(MAKE) test-python test-simple-knn
else
	$(MAKE) test-python
endif

# Compilers at a time: those of a make -j around it, if there is one.
PARALLEL = $(if $(findstring jobserver,$(MAKEFLAGS)),,-j $(JOBS))
CMAKE_CPP = $(CMAKE) -S . -B $(BUILD)/cpp -DCMAKE_BUILD_TYPE=Release -DAR_CORE_OBJECTS="$(CORE_OBJECTS)"
SANITIZE ?= ON
CMAKE_SANITIZED = $(CMAKE) -S . -B $(BUILD)/sanitized -DAR_SANITIZE=$(SANITIZE) -DAR_CORE_OBJECTS="$(CORE_OBJECTS)"
build-cpp: $(VENV)/.tools
	$(CMAKE_CPP)
	+$(CMAKE) --build $(BUILD)/cpp $(PARALLEL)

test-cpp: build-cpp
	cd $(BUILD)/cpp && $(dir $(CMAKE))ctest --output-on-failure -j $(JOBS)

# Every kernel for every architecture that a build without a GPU makes code for, warnings being errors. Needs nvcc
# and no GPU. Prints the CPU time of each file.
ARCHITECTURES ?= 75 80 90 100 120
NVCC ?= $(shell command -v nvcc || echo /usr/local/cuda/bin/nvcc)
CUDA_SOURCES := $(shell find csrc/cuda -name '*.cu')
ARCHITECTURE_OBJECTS := $(foreach a,$(ARCHITECTURES),$(CUDA_SOURCES:csrc/cuda/%.cu=$(BUILD)/architectures/$a/%.o))
test-architectures: $(ARCHITECTURE_OBJECTS)
$(ARCHITECTURE_OBJECTS): $(BUILD)/architectures/%.o: FORCE
	@mkdir -p $(dir $@)
	@bash -c 'TIMEFORMAT="$* %U s"; time $(NVCC) -std=c++17 -O3 --fmad=false --expt-relaxed-constexpr -Icsrc \
	  -Werror all-warnings -gencode arch=compute_$(firstword $(subst /, ,$*)),code=sm_$(firstword $(subst /, ,$*)) \
	  -c csrc/cuda/$(patsubst $(firstword $(subst /, ,$*))/%,%,$*).cu -o $@'
FORCE:

# The C++ tests again, under AddressSanitizer and UndefinedBehaviorSanitizer.
build-sanitized: $(VENV)/.tools
	$(CMAKE_SANITIZED)
	+$(CMAKE) --build $(BUILD)/sanitized $(PARALLEL)

test-sanitized: build-sanitized
	cd $(BUILD)/sanitized && $(dir $(CMAKE))ctest --output-on-failure -j $(JOBS) $(SANITIZED_CTEST)

# In less than half the time: see AR_SANITIZE in CMakeLists.txt. Kernels run on the host with up to four samples.
test-sanitized-quick: $(VENV)/.installed
	$(MAKE) test-sanitized SANITIZE=quick SANITIZED_CTEST='-E "<16>|InOtherTiles.Agree(In|Where)"' CORE_OBJECTS="$(EXTENSION_OBJECTS)"

# What is tested, downloaded and compiled side by side: pip and links leave cores idle.
ready: $(VENV)/.tools
	$(MAKE) -j $(JOBS) $(VENV)/.installed build-kernels-on-host npm SANITIZE=quick
	$(MAKE) build-tests

build-kernels-on-host: $(VENV)/.tools
	$(CMAKE_SANITIZED)
	+$(CMAKE) --build $(BUILD)/sanitized $(PARALLEL) --target kernels_on_host
	$(CMAKE_CPP)
	+$(CMAKE) --build $(BUILD)/cpp $(PARALLEL) --target kernels_on_host

build-tests: $(VENV)/.installed
	$(MAKE) -j $(JOBS) build-simple-knn build-sanitized build-cpp SANITIZE=quick \
	  CORE_OBJECTS="$(EXTENSION_OBJECTS)"

test-python: $(VENV)/.installed npm
	$(BIN)/python -m pytest -q $(TESTS)

# What tests compare files with. They skip where npm, or a network, is not.
NPM := $(BUILD)/npm
.PHONY: npm
npm:
	@[ -e $(NPM)/.installed ] || ! command -v npm > /dev/null || { mkdir -p $(NPM) && \
	  npm install --silent --no-save --ignore-scripts --prefix $(NPM) @playcanvas/splat-transform@3.7.0 \
	  gltf-validator@2.0.0-dev.3.10 @sparkjsdev/spark@2.2.0 three@0.187.0 && touch $(NPM)/.installed; } || echo "nothing from npm: going on without"

# Built in place and not installed, so that a simple_knn that VENV may have stays what it is.
build-simple-knn: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet "setuptools>=77" ninja pybind11
	cd simple_knn && $(abspath $(BIN))/python setup.py -q build_ext --inplace

test-simple-knn: build-simple-knn
	PYTHONPATH=simple_knn $(BIN)/python -m pytest -q -n 2 simple_knn/tests

# The viewer in chromium and Firefox, which draw in software. Elsewhere than on Debian as root, CHROMIUM and FIREFOX name
# the browsers. Tests of a browser that is missing are skipped, with the reason.
BROWSER_TESTS ?= tests/viewer tests/project/test_docs_browser.py
BROWSER_PACKAGES := chromium firefox-esr xvfb libgl1-mesa-dri libegl1 libgl1
test-browser: $(VENV)/.installed
	$(BIN)/python wheels/install.py --editable ".[test,test-browser]" || echo "no playwright: going on without"
	@if command -v apt-get > /dev/null && [ "$$(id -u)" = 0 ] && \
	  ! (command -v chromium && command -v firefox-esr && command -v Xvfb) > /dev/null; then \
	  apt-get update -qq && apt-get install -y -qq --no-install-recommends $(BROWSER_PACKAGES) > /dev/null || \
	  echo "no browsers from apt-get: going on without"; fi
	$(BIN)/python -m pytest -q -n0 -rs $(BROWSER_TESTS) $(BROWSER_OPTIONS)

# Random scenes with bad numbers in them, until one breaks a promise of docs/reliability.md.
fuzz: $(VENV)/.installed
	$(BIN)/python tests/fuzz.py --seconds $(FUZZ_SECONDS)

# Python tests of the extension built under the sanitizers, beside the usual one (docs/internals/testing.md): ten
# minutes to build, ten to run. libasan must come first in a process; libstdc++ with it, or exceptions find no handler.
SANITIZED := $(BUILD)/python-sanitized
SANITIZED_TESTS ?= tests/api/test_api.py tests/kernels/test_determinism.py tests/api/test_process.py
SANITIZED_SELECT ?= not exact and not memory and not instruction_sets and not another_process
PRELOAD = $(foreach name,libasan.so libstdc++.so.6,$(shell $(CXX) -print-file-name=$(name)))
test-python-sanitized: $(VENV)/.installed
	ANALYTIC_RASTERIZER_CUDA=0 ANALYTIC_RASTERIZER_SANITIZE=1 \
	  $(BIN)/python setup.py -q build --build-base $(SANITIZED) --build-lib $(SANITIZED)/lib
	LD_PRELOAD="$(PRELOAD)" ASAN_OPTIONS=detect_leaks=0 PYTHONMALLOC=malloc PYTHONPATH=$(SANITIZED)/lib \
	  $(BIN)/pytest -q -n0 $(SANITIZED_TESTS) -k "$(SANITIZED_SELECT)"

# The core on arbitrary bytes under the sanitizers, from a seed on; test-sanitized runs the first few.
SEED ?= 100000
SEEDS ?= 1000000
fuzz-core: $(VENV)/.tools
	$(CMAKE_SANITIZED)
	+$(CMAKE) --build $(BUILD)/sanitized $(PARALLEL) --target fuzz_core
	$(BUILD)/sanitized/fuzz_core $(SEED) $(SEEDS)

bench: $(VENV)/.installed
	[ -e $(SCENE) ] || $(MAKE) demo
	$(BIN)/python benchmarks/speed.py $(SCENE) --views $(VIEWS)

# For the torch of VENV, into the index of wheels in dist/, and tried in a fresh environment (wheels/build.py). With
# WHEEL_PYTHON=python3, for the torch of that Python, into which nothing is installed: it needs no network.
WHEEL_PYTHON ?=
WHEEL_TESTS ?= tests/api/test_api.py tests/kernels/test_footprints.py
wheel: $(if $(WHEEL_PYTHON),,$(VENV)/.torch)
	$(if $(WHEEL_PYTHON),,$(BIN)/python -m pip install --quiet "setuptools>=77" ninja pybind11 wheel pytest \
	  pytest-xdist scipy mpmath hypothesis)
	$(or $(WHEEL_PYTHON),$(BIN)/python) wheels/build.py dist $(WHEEL_TESTS)

# Strict: a dead link, a missing anchor or a name of the reference that is not there is an error. The docstrings are
# read, not imported: neither torch nor a compiler is needed. (With --quiet nothing would be strict.)
SITE ?= $(BUILD)/site
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir $(abspath $(SITE))
	@echo "$(SITE)/index.html"

format: $(VENV)/.tools
	$(BIN)/clang-format -i $(CPP_SOURCES)
	$(BIN)/ruff check --fix . && $(BIN)/ruff format .

lint: $(VENV)/.tools
	$(BIN)/clang-format --dry-run -Werror $(CPP_SOURCES)
	$(BIN)/ruff check . && $(BIN)/ruff format --check .

$(VENV)/.venv:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	touch $@

# The versions of the formatters are pinned: others format differently.
$(VENV)/.tools: $(VENV)/.venv
	$(BIN)/python -m pip install --quiet clang-format==23.1.5 ruff==0.17.5
	command -v cmake > /dev/null || $(BIN)/python -m pip install --quiet cmake
	@if command -v apt-get > /dev/null && [ "$$(id -u)" = 0 ] && ! [ -e /usr/include/gtest/gtest.h ]; then \
	  apt-get update -qq && apt-get install -y -qq g++ libgtest-dev > /dev/null; fi
	touch $@

$(VENV)/.docs: $(VENV)/.venv pyproject.toml
	$(BIN)/python -m pip install --quiet "pip>=25.1" && $(BIN)/python -m pip install --quiet --group docs
	touch $@

$(VENV)/.torch: $(VENV)/.venv
	$(BIN)/python -c "import torch" 2> /dev/null || $(BIN)/python -m pip install --quiet "$(TORCH)"
	touch $@

$(VENV)/.installed: $(VENV)/.torch $(SOURCES)
	$(BIN)/python wheels/install.py --editable ".[test]"
	touch $@

clean:
	rm -rf $(VENV) $(BUILD) $(OUT) analytic_rasterizer/*.so *.egg-info
	rm -rf simple_knn/build simple_knn/analytic_simple_knn/*.so simple_knn/*.egg-info
