# make quickstart   install into .venv and learn the embedded scene: nothing else to set up
# make test         install with the development tools, then lint, types, architecture, tests
# make docs         build the documentation into site/; needs no network once installed
# make house        lines and files of each folder, the longest files, circles of imports
# make gpu-check    install into .venv and check what this machine's GPU does, in minutes;
#                   with INSTALL_FIRST=no by $(PYTHON) and the packages that it has
# make rehearse     rehearse every setting that is made for a GPU, on embedded scenes: 37 minutes
#                   on two cores
# make chance       learn small moving scenes by several seeds, and count the frames that are lost
# make fuzz         what is too long for make test: fuzz tests of files with many inputs
#                   (make test has 60)
# make splat-viewer install a free viewer of splats into build/, by npm, and open an exported file
#                   in it: needs chromium and its driver
# make format       format the code and mend what the linter can
# make shell        a shell in which .venv is active
# make clean        remove .venv and everything that tools leave behind

PYTHON ?= python3
VENV ?= .venv
# `make CONSTRAINTS=` takes the newest releases that pyproject.toml allows.
CONSTRAINTS ?= constraints.txt

SPLAT_VIEWER := @mkkellogg/gaussian-splats-3d@0.4.7 three@0.187.0

BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check \
	$(if $(CONSTRAINTS),--constraint $(CONSTRAINTS)) --editable
# A file's tests run in one process: what they share is made once. The last files are small ones.
# The package is compiled once, whatever the shell says, not by each process that a test starts.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile \
	--no-loadscope-reorder --durations 15

.PHONY: quickstart test docs house gpu-check rehearse chance fuzz splat-viewer format shell clean

quickstart: $(VENV)/.installed
	$(BIN)/python -m devrf experiment=quickstart
	@echo
	@echo "For these commands: source $(BIN)/activate (or make shell). Then, too:"
	@echo "  python -m devrf experiment=quickstart data.shape=flower    # another scene"
	@echo "  python -m devrf stage=fetch scene=fox                      # real photographs"
	@echo "  python -m devrf stage=inspect data=inward data.root=PATH   # a scene of your own"

test: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(PYTEST)

docs: $(VENV)/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "The documentation: site/index.html"

house: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/house.py

gpu-check: $(if $(filter no,$(INSTALL_FIRST)),,$(VENV)/.installed)
	$(if $(filter no,$(INSTALL_FIRST)),PYTHONPATH=src:$(PYTHONPATH) $(PYTHON),$(BIN)/python) -m devrf stage=selfcheck

rehearse: $(VENV)/.installed
	$(BIN)/python benchmarks/rehearse.py

chance: $(VENV)/.installed
	$(BIN)/python benchmarks/robust_motion.py --small

fuzz: $(VENV)/.installed-dev
	DEVRF_FUZZ_INPUTS=100000 $(PYTEST) tests/scenes/test_formats_damaged.py
	DEVRF_FUZZ_INPUTS=5000 $(PYTEST) tests/checkpoints/test_checkpoint_contradictions.py

splat-viewer: $(VENV)/.installed-dev
	npm install --prefix build/splat_viewer --no-audit --no-fund $(SPLAT_VIEWER)
	$(BIN)/python -m pytest -rs tests/apps/export/test_free_viewer.py | tee build/splat_viewer/tests
	grep -q "1 passed" build/splat_viewer/tests  # not skipped

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

shell: $(VENV)/.installed
	@. $(BIN)/activate && exec $${SHELL:-/bin/sh}

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis build dist site

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
