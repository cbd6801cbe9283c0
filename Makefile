# make quickstart   install into .venv and learn the embedded scene: nothing else to set up
# make test         install with the development tools, then lint, types, architecture, tests
# make clean        remove .venv and everything that tools leave behind

PYTHON ?= python3
VENV ?= .venv
# `make CONSTRAINTS=` takes the newest releases that pyproject.toml allows.
CONSTRAINTS ?= constraints.txt

BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check \
	$(if $(CONSTRAINTS),--constraint $(CONSTRAINTS)) --editable

.PHONY: quickstart test clean

quickstart: $(VENV)/.installed
	$(BIN)/python -m devrf experiment=quickstart

test: $(VENV)/.installed-dev
	$(BIN)/ruff check src tests benchmarks notebooks
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis build dist

# The stamps say what is installed; a change of the requirements installs anew.
$(VENV)/.created:
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.installed: pyproject.toml constraints.txt | $(VENV)/.created
	$(INSTALL) .
	touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(VENV)/.created
	$(INSTALL) ".[dev]"
	touch $(VENV)/.installed $@
