# Two commands: `make demo` and `make test`. Both make .venv first; both are fast the second time.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: demo test lint types layers unit slow browser docs peers clean

demo: .venv/demo
	$(BIN)/prefrl run control/pendulum --out runs/pendulum
	$(BIN)/prefrl run text/reviews --out runs/reviews
	@echo
	@echo "two reports to open in a browser:"
	@echo "  runs/pendulum/report.html"
	@echo "  runs/reviews/report.html"

test: lint types layers unit slow browser docs

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev
	$(BIN)/mypy prefrl tests

layers: .venv/dev
	$(BIN)/lint-imports

unit: .venv/dev
	$(BIN)/python -m pytest --cov --cov-report=term

slow: .venv/dev
	$(BIN)/python -m pytest -m slow

browser: .venv/dev
	$(BIN)/python -m pytest -m browser

docs: .venv/dev
	$(BIN)/sphinx-build -q -W -b html docs docs/_build/html

# Peers for the benchmarks live in environments of their own: their pins conflict with ours, and with each other's.
peers: .venv-peers-text/ready .venv-peers-control/ready

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
