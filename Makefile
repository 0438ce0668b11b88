# make demo   train on the embedded synthetic pedestrians, evaluate, show the table and where the pictures are
# make test   install everything the tests need, and run them on every core
# Each makes its own virtual environment in .venv first; PYTHON chooses the interpreter (3.11 or newer).

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DEMO ?= runs/demo
JOBS ?= $(shell nproc 2>/dev/null || sysctl -n hw.ncpu)

.PHONY: demo test lint clean

demo: $(VENV)/.package
	rm -rf $(DEMO)
	$(BIN)/python train.py --config configs/quickstart.yaml --workdir $(DEMO)
	$(BIN)/python evaluate.py --workdir $(DEMO) --estimator imu_only
	$(BIN)/python evaluate.py --workdir $(DEMO)

# The compiled programs of the tests are kept between runs; the first run compiles them all, which is most of what it does: hence the
# compiler's lower level of optimisation.
test: $(VENV)/.tests
	JAX_PLATFORMS=cpu JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.jax_cache XLA_FLAGS="$(XLA_FLAGS) --xla_backend_optimization_level=1" $(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(PYTEST_ARGS)

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

clean:
	rm -rf $(VENV) .jax_cache .pytest_cache build *.egg-info

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "gnio-jax needs Python 3.11 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.package: $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e .
	touch $@

$(VENV)/.tests: $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	touch $@

$(VENV)/.dev: $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test,dev]'
	touch $@
