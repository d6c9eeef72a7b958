# On a fresh Debian or Ubuntu, `make demo` and `make test` do everything by themselves.
SHELL := /bin/bash
.DEFAULT_GOAL := help

# Some machines forbid byte code; each of the many processes would compile all of it again.
unexport PYTHONDONTWRITEBYTECODE

BIN := .venv/bin
CORE := .venv/.core
READY := .venv/.ready
COMPILED := .venv/.compiled
WORKERS ?= 2
# One thread of the linear algebra for each worker: with more they only wait for one another.
PYTEST := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 \
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadscope --no-loadscope-reorder

.PHONY: help setup demo test interpreted test-all test-other coverage fuzz check lint docs interface bench \
	results lock format clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(COMPILED) ## system libraries, .venv, all that tests need in its tested versions, compiled kernels

# What commands run, and what tests run beside; the stamp is written once all of it is there.
$(CORE): pyproject.toml constraints.lock scripts/setup.sh
	@scripts/setup.sh
	@touch $@

$(READY): pyproject.toml constraints.lock scripts/setup.sh
	@scripts/setup.sh dev
	@touch $(CORE) $@

$(COMPILED): $(READY) $(wildcard recon/*/kernels/*.py recon/*/kernels/*/*.py)
	@printf 'setup: %s\n' "$$($(BIN)/recon doctor --compile)"
	@touch $@

demo: $(CORE) ## map a synthetic street drive into outputs/demo/
	$(BIN)/recon demo

test: $(READY) ## fast tests, with style, types and import contracts; real data where RECON_DATA is set
	@$(MAKE) --no-print-directory -j2 $(COMPILED) interpreted
	$(PYTEST) -m "not slow"

# While the kernels are compiled, their tests run them interpreted.
interpreted: $(READY)
	NUMBA_DISABLE_JIT=1 $(PYTEST) -q tests/*/kernels

test-all: $(COMPILED) ## every test
	$(PYTEST)

PYTHON ?= 3.13
test-other: ## the tests marked portable, on another Python where there is one: PYTHON=3.12, or a path
	@scripts/test_other.sh $(PYTHON)

coverage: $(COMPILED) ## fast tests, and how much of each folder they run, kernels apart
	$(PYTEST) -q -m "not slow" --cov --cov-report=
	@$(BIN)/coverage report | awk ' \
		/^recon/ {split($$1, part, "/"); folder = part[1] "/" part[2]; all[folder] += $$2; missed[folder] += $$3} \
		/^TOTAL/ {all["total"] = $$2; missed["total"] = $$3} \
		END {for (name in all) printf "%-24s %5d statements %4d %%\n", name, all[name], 100 - 100 * missed[name] / all[name]}' | sort

fuzz: $(COMPILED) ## search at random for failing examples; MINUTES=30, SEED=… repeats a round
	@scripts/fuzz.sh

check: lint test ## what CI runs, with the quick answers first

lint: $(READY) ## style, formatting, types and import contracts
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(READY) ## the pages as a site, in build/site/index.html; links that lead nowhere are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

interface: $(READY) ## write docs/commands.md, and the public names that the tests compare
	@$(BIN)/python scripts/record_interface.py

bench: $(COMPILED) ## speed of the matchers beside OpenCV's, as JSON; of drives beside the last tag, OTHER=…
	@$(BIN)/python benchmarks/matching.py --json
	@$(BIN)/python benchmarks/two_checkouts.py $(if $(OTHER),--other $(OTHER))

results: $(COMPILED) ## measure the tables of the pages, or some: ONLY="movers kitti"; hours in all
	@$(BIN)/python benchmarks/results.py $(if $(ONLY),--only $(ONLY))

lock: $(READY) ## write the hashes of the versions of constraints.txt into constraints.lock
	@scripts/lock.sh

format: $(READY) ## put the code into the project's style
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

clean: ## remove .venv, caches and builds; outputs/ stays
	rm -rf .venv .venv-3.* build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
