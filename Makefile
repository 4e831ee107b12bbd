# Two commands: `make demo` and `make test`. Both make .venv first; both are fast the second time.
#
# `make test` is what CI runs. Beside it: `make unit` (the default tests alone), `make budget` (do they take no longer
# than they may? on an idle machine), `make cover`, and `make nightly` (more kills, stories and examples than CI does).
PYTHON ?= python3
BIN := .venv/bin
PYTEST = .ci/in_memory $(BIN)/python -m pytest -n auto --dist worksteal --hypothesis-seed=$(SEED)
# Reading all tests to leave most of them out takes as long as a tenth of them.
HOLDING = $(shell grep -rl --include='test_*.py' 'mark\.$(1)' tests)
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

# What hypothesis makes up depends on this alone: `make unit SEED=...` makes the same again.
ifndef SEED
SEED := $(shell od -An -N4 -tu4 /dev/urandom | tr -d ' ')
endif
export SEED

.PHONY: demo test reading running tests lint types layers unit slow browser docs cover budget nightly mutants peers clean

demo: .venv/demo
	$(BIN)/prefrl run control/pendulum --out runs/pendulum
	$(BIN)/prefrl run text/reviews --out runs/reviews
	@echo
	@echo "two reports to open in a browser:"
	@echo "  runs/pendulum/report.html"
	@echo "  runs/reviews/report.html"

# Two groups side by side, each in its order; what a step says comes at once when it is over.
test: .venv/dev
	@echo "everything is made up from SEED=$(SEED)"
	+$(MAKE) --no-print-directory --output-sync=target -j2 reading running

reading: .venv/dev
	$(MAKE) --no-print-directory lint
	$(MAKE) --no-print-directory layers
	$(MAKE) --no-print-directory docs
	$(MAKE) --no-print-directory types

running: .venv/dev
	+.ci/in_memory --shared $(MAKE) --no-print-directory tests

# One after another, whatever make is told: each takes all cores. Browsers need a run of their own: Playwright's event
# loop lives in the main thread.
tests: .venv/dev
	$(MAKE) --no-print-directory unit
	$(MAKE) --no-print-directory slow
	$(MAKE) --no-print-directory browser

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev
	$(BIN)/mypy prefrl tests

layers: .venv/dev
	$(BIN)/lint-imports

unit: .venv/dev
	$(PYTEST)

slow: .venv/dev
	$(PYTEST) -m slow $(call HOLDING,slow)

browser: .venv/dev
	$(PYTEST) -m browser $(call HOLDING,browser)

nightly: .venv/dev mutants
	$(PYTEST) -m nightly $(call HOLDING,nightly)

# Breaks the product in one place at a time: do the tests notice?
mutants: .venv/dev
	.ci/in_memory $(BIN)/python tests/mutants/mutate.py

cover: .venv/dev
	$(PYTEST) --cov --cov-report=term

budget: .venv/dev
	$(PYTEST) --budget

docs: .venv/dev
	$(BIN)/sphinx-build -q -W -b html docs docs/_build/html

# Peers for the benchmarks live in environments of their own: their pins conflict with ours, and with each other's.
peers: .venv-peers-text/ready .venv-peers-ppo/ready .venv-peers-control/ready

.venv-peers-%/ready: benchmarks/peers-%.txt
	$(PYTHON) -m venv .venv-peers-$*
	.venv-peers-$*/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	touch $@

.venv/bin/python:
	$(PYTHON) -m venv .venv

# torch goes first and alone, so that nothing that depends on it can choose another build.
.venv/torch: constraints.txt | .venv/bin/python
	$(PIP) torch
	touch $@

.venv/demo: pyproject.toml .venv/torch
	$(PIP) -e ".[all]"
	touch $@

.venv/dev: pyproject.toml .venv/torch
	$(PIP) -e ".[dev]"
	touch $@ .venv/demo

clean:
	rm -rf .venv .venv-peers-* build dist *.egg-info docs/_build
