# Each target sets up what it needs: an environment in $(VENV), made once and renewed when what it needs changes.
#   make test    run the test suite
#   make lint    check style, types and the direction of imports
#   make docs    build the documentation as a site, in site/
#   make demo    the scene that ships made small, then each command of the method once, in three minutes
# Use an environment of your own with `make test VENV=/path/to/env`.

VENV ?= .venv
# open3d below 0.20, which nerfstudio's exporter needs, has no wheels for Python 3.13 and later.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.10 python3; do \
	"$$p" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))' >/dev/null 2>&1 && { echo "$$p"; break; }; \
	done)
STAMP := $(VENV)/.pointsplat-installed

# Tests run side by side in so many processes, on one thread each.
WORKERS ?= 2

# Threads that wait for one another spin briefly and then sleep: much faster where other programs run as well.
export GOMP_SPINCOUNT ?= 20000

.PHONY: setup test lint docs demo clean

setup: $(STAMP)

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "no Python 3.10, 3.11 or 3.12 found; install one or pass PYTHON=/path/to/python" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(STAMP): pyproject.toml setup.py | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --disable-pip-version-check -e '.[dev]'
	@touch $@

# Compiles the kernels if their sources have changed; without a compiler torch computes everything.
test: $(STAMP)
	$(VENV)/bin/python setup.py build_ext --inplace
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest --numprocesses $(WORKERS)

lint: $(STAMP)
	$(VENV)/bin/python -m ruff check .
	$(VENV)/bin/python -m ruff format --check .
	$(VENV)/bin/python -m mypy
	$(VENV)/bin/lint-imports --no-cache

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --strict

demo: $(STAMP)
	$(VENV)/bin/python -m lab.demo

clean:
	rm -rf pointsplat_ns/system/kernels.*.so build dist site *.egg-info .pytest_cache .ruff_cache .mypy_cache .import_linter_cache .hypothesis lab/viewers/node_modules
