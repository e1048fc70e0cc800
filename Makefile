# `make help` lists the targets. Everything runs in .venv, which `make setup` makes and later runs reuse.

.DEFAULT_GOAL := setup
.NOTPARALLEL:
.PHONY: help setup egl demo figures tables libero libero-setup check test test-all guard lint typecheck format clean

# The demo's total time counts the set-up, so the clock starts before anything else does.
STARTED_AT := $(shell date +%s)

DEMOS ?= 10
EPISODES ?= 20
STATES ?= 50
TASKS ?= 0-9
SUITE ?=
PYTEST_ARGS ?=
FIGURES ?=
# The tests of a file share what they make, so a file stays in one process; each has one of two cores.
TWO_PROCESSES := -n 2 --dist loadfile

BIN := .venv/bin

ifeq ($(shell uname -s),Linux)
export MUJOCO_GL ?= egl
endif
export PYTHON

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

setup: ## make .venv with Python 3.12 or 3.13 (PYTHON=... chooses one) and install everything
	@scripts/setup.sh

egl: setup
	@$(BIN)/python scripts/check_egl.py

demo: egl ## collect DEMOS demonstrations, train, evaluate EPISODES episodes
	@$(BIN)/openspm demo --demos=$(DEMOS) --episodes=$(EPISODES) --started_at=$(STARTED_AT)

figures: egl ## take the published figures (FIGURES="NAME ..." some of them) that are missing or stale, on LIBERO too if it is installed: hours
	@$(BIN)/python -m benchmarks.figures $(FIGURES)

# LIBERO and its scenes are hundreds of megabytes that only these figures need.
# Like set-up's, the stamp lets another pyproject.toml, say with a new bound, install again.
LIBERO_STAMP := .venv/.openspm-libero
libero-setup: egl ## install LIBERO, with its meshes and textures
	@cksum <pyproject.toml | cmp -s - $(LIBERO_STAMP) || { \
		$(BIN)/python -m ensurepip >/dev/null && \
		$(BIN)/python -m pip install --no-input --disable-pip-version-check --editable '.[libero]' && \
		cksum <pyproject.toml >$(LIBERO_STAMP); }
	@$(BIN)/python scripts/libero_assets.py

libero: libero-setup ## the same on LIBERO's SUITE (libero_goal): DEMOS, STATES initial states of TASKS (0-9); see docs/libero.md
	@$(BIN)/python -m benchmarks.libero.run $(addprefix --suite=,$(SUITE:libero_goal=)) \
		--demos=$(DEMOS) --states=$(STATES) --tasks=$(TASKS)

tables: setup ## write docs/results.md and README's figures from what was measured (benchmarks/results)
	@$(BIN)/python -m benchmarks.tables

check: lint test ## lint and test: what has to be green before a commit

test: egl ## run the tests, without those marked slow, libero or gpu (PYTEST_ARGS=... adds arguments)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(TWO_PROCESSES) $(PYTEST_ARGS)

test-all: egl ## run the slow tests too, and let the properties explore (PYTEST_ARGS=--hypothesis-seed=0 repeats a run)
	@OMP_NUM_THREADS=1 HYPOTHESIS_PROFILE=explore $(BIN)/python -m pytest $(TWO_PROCESSES) \
		-m "not libero and not gpu" $(PYTEST_ARGS)

guard: $(if $(filter libero,$(SUITE)),libero-setup,egl) ## record, train and run episodes of SUITE (tabletop, or libero) from pixels; fails below the success floor
	@$(BIN)/python -m benchmarks.guard $(addprefix --suite=,$(SUITE))

lint: setup ## ruff's rules and format, then the types; changes nothing
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright

typecheck: setup ## the types alone
	@$(BIN)/pyright

format: setup ## put the code into ruff's format and mend what ruff can mend
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

clean: ## remove caches and built packages; .venv and outputs/ stay
	@rm -rf build dist .pytest_cache .ruff_cache .hypothesis
	@find src tests benchmarks examples scripts -name __pycache__ -type d -prune -exec rm -rf {} +
