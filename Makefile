# meshkit: every target does its own set-up in .venv; nothing else on the machine is touched.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check

.DEFAULT_GOAL := help
.PHONY: help demo test docs lint format scatter clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(READY) ## train X-DualNet for about eight minutes on the shipped bodies and draw the results
	$(BIN)/python recipes/xdualnet.py --name demo --minutes 8 --resume
	@echo "Pictures: $(CURDIR)/runs/demo"; ls runs/demo/*.png

test: lint ## lint, then run every test and docstring example
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile

docs: $(READY) ## build the documentation site, tutorials included, in docs/_build/html
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -q -d docs/_build/doctrees docs docs/_build/html
	@echo "Site: $(CURDIR)/docs/_build/html/index.html"

lint: $(READY) ## ruff and mypy
	$(BIN)/ruff check --quiet
	$(BIN)/ruff format --check --quiet
	$(BIN)/mypy

format: $(READY) ## rewrite the sources in the project's style
	$(BIN)/ruff check --fix --quiet
	$(BIN)/ruff format --quiet

scatter: $(READY) ## build the optional torch-scatter backend in .venv, seven minutes or more, and test it
	$(PIP) install --no-build-isolation torch-scatter==2.1.2
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/test_scatter.py

clean: ## remove the virtual environment, caches and builds (runs/ is kept)
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage *.egg-info
	rm -rf docs/_build docs/auto_examples docs/api docs/sg_execution_times.rst
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Re-made only when the pins or the package's metadata change; an interrupted set-up leaves no stamp and starts again.
$(READY): requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null \
		|| { echo "meshkit needs Python 3.10 or newer as '$(PYTHON)'; try: make PYTHON=python3.11 $(MAKECMDGOALS)" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
		|| { echo "'$(PYTHON)' has no venv module; on Debian or Ubuntu install the python3-venv package" >&2; exit 1; }
	@echo "Setting up $(VENV) (a few minutes the first time) ..."
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	@$(PIP) install "$$(head -n 1 requirements.txt)"
	@$(PIP) install -r requirements.txt
	@$(PIP) install --no-deps --no-build-isolation -e .
	@touch $@
