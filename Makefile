# Needs python3 (3.11 or later) with pip and venv. Every target installs what it needs into .venv.

PYTHON ?= python3
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
# With -e, the targets run the clone as it is, also where an earlier installation without it had a copy.
# Imports compile what they use: a minute less than compiling every file of every package here.
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check --quiet --no-compile -c constraints.txt -e
# They write that to disk: images for containers often forbid it, and each process then takes seconds longer.
export PYTHONDONTWRITEBYTECODE :=

# "make paper trials=50" passes trials=50 to Hydra, and so every variable of the command line except PYTHON and ARGS.
OVERRIDES = $(strip $(foreach name,$(filter-out PYTHON ARGS,$(.VARIABLES)),$(if \
	$(findstring command line,$(origin $(name))),'$(name)=$($(name))')) $(ARGS))

.DEFAULT_GOAL := help
.PHONY: help paper test test-rest lint docs clean

help:
	@echo "make paper   run the paper's experiment, some 8 minutes, and write outputs/paper/report.html"
	@echo "             (make paper trials=5 changes a setting, as does ARGS='trials=5 seed=1')"
	@echo "make test    test the package (ARGS='-m unit' selects)"
	@echo "make test-rest   test scripts, documentation and its notebooks, pages in a browser, launchers and forks"
	@echo "make lint    ruff, mypy, import-linter"
	@echo "make docs    build the documentation in outputs/docs, executing its notebooks"
	@echo "make clean   remove .venv and the tools' caches; outputs/ stays"
	@echo "PYTHON=python3.12 chooses the interpreter of .venv, where the clone is installed with pip's -e."

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "autdtorch needs Python 3.11 or later; make PYTHON=python3.12 chooses one")'
	$(PYTHON) -m venv $(VENV)

$(INSTALLED): pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) .
	@touch $@

$(INSTALLED)-%: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) '.[$*]'
	@touch $@

paper: $(INSTALLED)
	$(BIN)/autdtorch experiment=paper $(OVERRIDES)

# Once for all processes of the tests, which would each take 30 s for kernels and 10 s for modules
$(VENV)/.kernels: $(wildcard autdtorch/fdtd/kernels/*.py autdtorch/methods/holography/*.py autdtorch/scene/obstacles/*.py) | $(INSTALLED)-dev
	jobs=; for dtype in float32 float64; do $(BIN)/python tests/compile_kernels.py $$dtype & jobs="$$jobs $$!"; done; \
		$(BIN)/python -m pytest --collect-only -q >/dev/null; for job in $$jobs; do wait $$job || exit 1; done
	@touch $@

PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 8
# Files alone that hold such tests: to import all files takes each process seconds.
REST = tests/browser tests/docs $(shell grep -rl --include='test_*.py' mark.processes tests)

test: $(INSTALLED)-dev $(VENV)/.kernels
	$(PYTEST) --dist worksteal -m 'not (docs or browser or processes)' $(ARGS)

# By file, as the live view, the documentation and reports take 5 to 20 s to make
test-rest: $(INSTALLED)-dev $(VENV)/.kernels
	$(PYTEST) --dist loadfile -m 'docs or browser or processes' $(REST) $(ARGS)

lint: $(INSTALLED)-dev
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(INSTALLED)-docs
	$(BIN)/python -m sphinx -W --keep-going -d outputs/.doctrees docs outputs/docs

clean:
	rm -rf $(VENV) build dist .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find autdtorch tests -name __pycache__ -type d -exec rm -rf {} +
