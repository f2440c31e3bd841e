# Two commands: `make run` and `make test`. Both prepare .venv first; nothing but Python 3.11 or newer is needed.
PYTHON ?= python3
BIN := .venv/bin
CONFIG ?= configs/point_maze_me_es.yaml

.PHONY: run test quick long lint clean

run: .venv/installed
	$(BIN)/es-service run $(CONFIG)

# Those of the system start processes of their own and look at clocks, so they run one after another.
test: .venv/installed-dev lint
	$(BIN)/python -m pytest -n auto --dist loadfile tests/es_service tests/laws tests/workers
	$(BIN)/python -m pytest tests/system

# Before an issue is closed: fifty kills in one run, a cluster whose hosts come, go, hang and die.
long: .venv/installed-dev
	$(BIN)/python -m pytest -m long tests

# While writing code: no lint, no tests of more than five seconds, none of the whole system.
quick: .venv/installed-dev
	$(BIN)/python -m pytest -n auto --dist loadfile -m 'not slow' tests/es_service tests/laws tests/workers

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Python 3.11 or newer is needed; try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
# Without the system's package for it, Debian's Python leaves half a .venv, which the next `make` would take for whole.
	@$(PYTHON) -m venv .venv || { rm -rf .venv; \
	  echo "$(PYTHON) could not make .venv, for the reason above; on Debian and Ubuntu install python3-venv" \
	  "(of another Python than the system's: python3.12-venv, say), then again: make $(MAKECMDGOALS)"; exit 1; }

.venv/installed: .venv/bin/python pyproject.toml constraints.txt
	@echo "installing pinned packages into .venv; this takes a minute the first time"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	@touch $@

.venv/installed-dev: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

clean:
	rm -rf .venv build *.egg-info
