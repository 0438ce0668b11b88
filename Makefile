# make demo   train on the embedded synthetic pedestrians, evaluate, show the table and the pictures
# make test   install everything the tests need, and run them on every core
# make test-all   the tests that are marked slow, too: continuous integration runs these
# make lint   ruff and pyright
# make pedestrian   the network that comes with gnio-jax anew, from Tyrex and Indoor Location below
#             $GNIO_DATA: an hour on two slow cores
# make docs   the documentation as a site, in site/index.html; its notebooks run
# make links  ask every external link of the pages if it answers; needs a network
#
# Each makes its own virtual environment in .venv first. PYTHON chooses the interpreter (3.11 or
# newer). EXTRAS=test,reference adds evo, PyTorch and Rerun, which some tests compare with. Packages
# are installed by uv, in a quarter of pip's time. It does not read pip's settings: INSTALLER=pip
# where those choose an index.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
RUNS ?= runs
DEMO ?= $(RUNS)/demo
JOBS ?= $(shell nproc 2>/dev/null || sysctl -n hw.ncpu)
EXTRAS ?= test
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
INSTALLER ?= uv
UV := $(BIN)/uv pip install --quiet --python $(BIN)/python
ifeq ($(INSTALLER),uv)
INSTALL := $(UV)
NEEDED := $(BIN)/uv
else
INSTALL := $(PIP) --no-compile
endif
NEEDS := gnio-jax needs Python 3.11 or newer: make PYTHON=python3.11 ...

# The compiled programs of the tests are kept between runs: the first run compiles them all, which is
# most of what it does. Python's own are kept too, whatever the shell says: every worker and every
# process that a test starts would compile the package and the tests anew.
TEST_ENVIRONMENT := JAX_PLATFORMS=cpu JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.jax_cache \
	PYTHONDONTWRITEBYTECODE=
# A file stays with one worker, or both would train what its tests share; the longest come first.
SHARED_OUT := --dist loadfile --no-loadscope-reorder

# No rules but these.
MAKEFLAGS += --no-builtin-rules

.PHONY: demo pedestrian test test-all lint docs links clean

demo: $(VENV)/.package
	rm -rf $(DEMO)
	$(BIN)/gnio train --config quickstart --workdir $(DEMO)
	$(BIN)/gnio evaluate --network $(DEMO) --estimator imu_only
	$(BIN)/gnio evaluate --network $(DEMO)

# A network on windows of a quarter of the width learns from poses between the waypoints, the
# direction of a walk from the gait alone first, and then with the heading of the device. With the
# smoother it makes truer poses, from which a GRU learns.
FIRST := --config pedestrian_windows --model.width 16 --set augment.mirror_share=0 \
	--set augment.rocking_share=0 --set "augment.vertical_gain=[1,1]"
POSES := --set data.poses_by=$(RUNS)/pedestrian_first_calibrated
PATHS := --set segments.seconds=12 --set segments.horizon_weight=10 --optim.epochs 70 \
	--optim.batch-size 12 --optim.learning-rate 5e-4 --optim.best-by latest
pedestrian: $(VENV)/.package
	rm -rf $(RUNS)/pedestrian_first $(RUNS)/pedestrian_first_gait
	rm -rf $(RUNS)/pedestrian_first_calibrated
	rm -rf $(RUNS)/pedestrian $(RUNS)/pedestrian_6s $(RUNS)/pedestrian_calibrated
	$(BIN)/gnio train $(FIRST) --set augment.hidden_axes_share=1 --optim.epochs 3 \
		--workdir $(RUNS)/pedestrian_first_gait
	$(BIN)/gnio train $(FIRST) --optim.epochs 4 \
		--init-from $(RUNS)/pedestrian_first_gait --workdir $(RUNS)/pedestrian_first
	$(BIN)/gnio calibrate --network $(RUNS)/pedestrian_first
	$(BIN)/gnio train --config pedestrian $(POSES) --workdir $(RUNS)/pedestrian_6s
	$(BIN)/gnio train --config pedestrian $(POSES) $(PATHS) --init-from $(RUNS)/pedestrian_6s \
		--workdir $(RUNS)/pedestrian
	$(BIN)/gnio calibrate --network $(RUNS)/pedestrian --average-headings --fit measurement noise

test: $(VENV)/.with-$(EXTRAS)
	$(TEST_ENVIRONMENT) $(BIN)/python -m pytest -n $(JOBS) $(SHARED_OUT) -m 'not slow' $(PYTEST_ARGS)

test-all: $(VENV)/.with-$(EXTRAS)
	$(TEST_ENVIRONMENT) $(BIN)/python -m pytest -n $(JOBS) $(SHARED_OUT) $(PYTEST_ARGS)

lint: $(VENV)/.with-test,dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: $(VENV)/.with-docs
	PYTHONPATH=$(CURDIR) $(BIN)/mkdocs build --strict

links: $(BIN)/python
	$(BIN)/python scripts/external_links.py

clean:
	rm -rf $(VENV) .jax_cache .pytest_cache build site *.egg-info

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "$(NEEDS)")'
	$(PYTHON) -m venv $(VENV)

$(BIN)/uv: | $(BIN)/python
	$(PIP) uv

$(VENV)/.package: $(BIN)/python pyproject.toml setup.py | $(NEEDED)
	$(INSTALL) -e .
	touch $@

# The package with extras. Nothing is compiled here: Python compiles what it imports, which is a third
# of the packages' modules.
$(VENV)/.with-%: $(BIN)/python pyproject.toml setup.py | $(NEEDED)
	$(INSTALL) -e '.[$*]'
	touch $@
