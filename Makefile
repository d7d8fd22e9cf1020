# Needs only make and Python 3.11 or later; everything else goes into the project's own .venv.
PYTHON ?= python3
JOBS ?= 2
DEMO ?= runs/demo
ROOMS ?= runs/rooms
ONLY ?= doorkey training options loop limits

VENV := .venv
# The versions to install; empty for the newest.
LIMITS := constraints.txt
BIN := $(VENV)/bin
USER := $(VENV)/.installed
STAMP := $(VENV)/.installed-dev

.DEFAULT_GOAL := help
.PHONY: help setup demo test kernels versions floors newest slurm check bench docs clean

help: ## what one can make
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-7s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(STAMP) ## make .venv and install hypogoal and the developers' tools, tested versions (once)

# A half-made .venv (Debian without python3-venv) must not pass for a whole one at the next call.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "hypogoal needs Python 3.11 or later: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
		{ rm -rf $(VENV); echo "python could not make a virtual environment: install python3-venv" >&2; exit 1; }

$(USER): pyproject.toml $(LIMITS) | $(BIN)/python
	@echo "installing hypogoal and its dependencies into $(VENV) (some minutes the first time)"
	@$(BIN)/python -m pip install --quiet $(addprefix --constraint ,$(LIMITS)) --editable .
	@touch $@

$(STAMP): pyproject.toml $(LIMITS) | $(BIN)/python
	@echo "installing hypogoal, its dependencies and the developers' tools into $(VENV) (some minutes the first time)"
	@$(BIN)/python -m pip install --quiet $(addprefix --constraint ,$(LIMITS)) --editable '.[dev]'
	@touch $(USER) $@

# An unfinished demo is continued, a finished one only shown again; for a fresh one remove $(ROOMS) and $(DEMO).
# The rooms take what DoorKey leaves of the cores. A shell has what it runs beside it ignore Ctrl-C: hence the trap.
demo: $(USER) ## three-key DoorKey, in runs/demo, and where an ensemble is needed, in runs/rooms: from nothing to a report
	@nice -n 19 $(BIN)/hypogoal run rooms --preset demo --out $(ROOMS) --quiet $(if $(wildcard $(ROOMS)),--resume) & rooms=$$!; \
	trap 'kill $$rooms 2>/dev/null; wait $$rooms' EXIT; trap 'exit 130' INT TERM; \
	$(BIN)/hypogoal run doorkey --preset demo --out $(DEMO) $(if $(wildcard $(DEMO)),--resume) && \
	{ echo "waiting for $(ROOMS)"; wait $$rooms; }
	@echo "open $(ROOMS)/report/index.html and $(DEMO)/report/index.html in a browser; for the command hypogoal type: source $(BIN)/activate"

# A file's tests share what they made; files in the order that tests/conftest.py gives them, the longest first.
PARALLEL := -n $(JOBS) --dist loadfile --no-loadscope-reorder
test: $(STAMP) ## the tests, without those marked slow or slurm
	$(BIN)/python -m pytest $(PARALLEL) $(TESTS)

# Other processors round otherwise: the oldest kernels, made (tests/uneven.py) to depend on the batch around a state.
# Both at once are stricter than each alone, at half the cost; tests/uneven.py without OLDEST shows which one failed.
NUMERIC := tests/hypotheses tests/options/test_termination.py tests/meta/test_resuming.py
OLDEST := ATEN_CPU_CAPABILITY=default MKL_ENABLE_INSTRUCTIONS=SSE4_2 ONEDNN_MAX_CPU_ISA=SSE41
kernels: $(STAMP) ## the tests of what is computed, as on other processors (before a release; CI's is another anyway)
	$(OLDEST) $(BIN)/python -m pytest $(PARALLEL) -p tests.uneven $(NUMERIC)

OTHERS := 3.12 3.13
versions: ## the tests on the other versions of Python, where they are at hand
	@for version in $(OTHERS); do \
		if python$$version -c "" 2>/dev/null; then \
			$(MAKE) test PYTHON=python$$version VENV=.venv-$$version || exit 1; \
		else echo "no Python $$version here"; fi; \
	done

FLOORS := build/floors.txt
$(FLOORS): pyproject.toml
	@mkdir -p $(@D)
	@sed -n '/^dependencies/,/^\[project.scripts/p' $< | grep -oE '"[a-z0-9-]+>=[0-9.]+' | tr -d '"' | sed 's/>=/==/' | sort -u >$@

floors: $(FLOORS) ## the tests on the lowest versions that pyproject.toml allows, in .venv-floors
	$(MAKE) test VENV=.venv-floors LIMITS=$(FLOORS)

newest: ## the tests on the newest versions that pip finds, in .venv-newest
	$(MAKE) test VENV=.venv-newest LIMITS=

slurm: $(STAMP) ## the test of sweeps on a real Slurm, where there is one (some minutes)
	$(BIN)/python -m pytest -m slurm tests/experiments/test_slurm.py

check: $(STAMP) ## linter, formatter, types, import contracts, vague names, published numbers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.vague_names
	$(BIN)/python -m studies.recompute

bench: $(STAMP) ## what is faster than what, in ratios (BENCH=--short for a quick look, ONLY="doorkey loop", OTHER=CHECKOUT beside it)
ifdef OTHER
	$(BIN)/python -m benchmarks.beside $(OTHER) --only $(ONLY) $(BENCH)
else
	for name in $(ONLY); do $(BIN)/python -m benchmarks.$$name $(BENCH) || exit 1; done
endif

docs: $(STAMP) ## the documentation as a site, in site/
	$(BIN)/python -m mkdocs build --strict

clean: ## remove caches and builds; data/, runs/ and .venv stay
	rm -rf build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
