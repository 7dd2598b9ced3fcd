# make run: everything on the embedded twin. make test: lint and quick tests. Both set up what is missing first.
# make docs: the site, strictly, into site/. make gazebo-classic: the world plugin of simulator=gazebo_classic.
# make test-long: the tests that take seconds. make test-slow: those that take minutes.
# make test-portable: the numeric ones again, as on other processors. make check: all but test-slow (.ci/run).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: run test test-long test-slow test-portable check lint format bench docs gazebo-classic setup uv.lock clean

run: $(READY)
	$(BIN)/python run.py stage=pipeline

test: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow and not long" -n 2 --dist loadgroup

test-long: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "long and not slow" -n 2 --dist loadgroup

test-slow: $(READY)
	$(BIN)/python -m pytest -m slow

test-portable: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python tests/portable.py -n 2 --dist loadgroup

check:
	.ci/run

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(READY)
	$(BIN)/python benchmarks/bench.py

docs: $(READY)
	@$(BIN)/python -c 'import mkdocs, mkdocstrings_handlers.python' 2> /dev/null || $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "open site/index.html"

# Compiles where Gazebo's headers are: here, or in the root directory R2S_GAZEBO_ROOT (docs/how_to/gazebo.md).
GAZEBO := r2s/engines/gazebo_classic.cc
PLUGIN := r2s/engines/libr2s_gazebo_classic.so
COMPILE := g++ -std=c++17 -O2 -shared -fPIC
CHROOT := $(if $(filter 0,$(shell id -u)),chroot,unshare --map-root-user chroot)
gazebo-classic:
ifdef R2S_GAZEBO_ROOT
	@test -x $(R2S_GAZEBO_ROOT)/usr/bin/gzserver || { echo "error: R2S_GAZEBO_ROOT=$(R2S_GAZEBO_ROOT) is no root directory with gzserver; see docs/how_to/gazebo.md" >&2; exit 2; }
	cp $(GAZEBO) $(R2S_GAZEBO_ROOT)/tmp/r2s.cc
	$(CHROOT) $(R2S_GAZEBO_ROOT) sh -c '$(COMPILE) /tmp/r2s.cc -o /tmp/r2s.so $$(pkg-config --cflags gazebo)'
	cp $(R2S_GAZEBO_ROOT)/tmp/r2s.so $(PLUGIN)
else
	@pkg-config --exists gazebo || { echo "error: pkg-config finds no headers of Gazebo 11: install libgazebo-dev, or give R2S_GAZEBO_ROOT=FOLDER; see docs/how_to/gazebo.md" >&2; exit 2; }
	$(COMPILE) $(GAZEBO) -o $(PLUGIN) $$(pkg-config --cflags gazebo)
endif

setup: $(READY)

# The versions of constraints.txt for uv. Afterwards `uv sync` installs what `make setup` does.
uv.lock: $(READY)
	$(BIN)/python tests/pins.py
	uv lock

# The pins of constraints.txt are what the tests were seen to pass with. `torch==2.13.0` is whatever build the user's
# package index gives for that pin: CUDA by default on Linux, the CPU build from a CPU index.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and f"Python >= 3.11 is needed; {sys.executable} is {sys.version.split()[0]}; try make PYTHON=python3.11 ...")'
	@echo "setting up $(VENV) (once; a minute or two)"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $(READY)

clean:
	rm -rf $(VENV) site .mypy_cache .ruff_cache .pytest_cache *.egg-info
