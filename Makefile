# Two commands: `make run` and `make test`. Both prepare .venv first; nothing but Python 3.11 or newer is needed.
# Packages are installed by uv if it is on the PATH, otherwise by pip (`make UV= run` always takes pip).
PYTHON ?= python3
UV ?= $(shell command -v uv 2>/dev/null)
BIN := .venv/bin
# Processes start in half the time if Python keeps the bytecode of what they import: it is in .venv, which is ours.
unexport PYTHONDONTWRITEBYTECODE
CONFIG ?= configs/point_maze_memes.yaml
START := $(shell date +%s)
# The downloads of `run` and of `test`, as of 25 November 2026 on Linux x86-64 with Python 3.11 (sizes of the wheels).
PACKAGES := 76 packages, about 375 MB
PACKAGES_DEV := 181 packages, about 630 MB

.PHONY: run test tests quick long lint clean

run: .venv/installed
	@began=$$(date +%s) && $(BIN)/es-service run $(CONFIG) && ended=$$(date +%s) && \
	  echo "make run: installing $$((began - $(START))) s, running $$((ended - began)) s"

test: .venv/installed-dev
	@began=$$(date +%s) && $(MAKE) --no-print-directory lint && linted=$$(date +%s) && \
	  $(MAKE) --no-print-directory tests && ended=$$(date +%s) && \
	  echo "make test: lint $$((linted - began)) s, tests $$((ended - linted)) s, all $$((ended - $(START))) s"

# Those of the system start processes of their own, so two at a time; those that look at clocks run when nothing else
# computes, and mostly wait.
tests: .venv/installed-dev
	$(BIN)/python -m pytest -n auto --dist loadfile tests/es_service tests/laws tests/workers
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'not alone and not long and not image' tests/system
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'alone and not long and not image' tests/system

# Before an issue is closed: fifty kills in one run, a cluster whose hosts come, go, hang and die, browsers.
long: .venv/installed-dev
	$(BIN)/python -m pytest -n auto --dist worksteal -m long tests/es_service tests/laws tests/workers
	$(BIN)/python -m pytest -n 2 --dist worksteal -m 'long and not alone' tests/system
	$(BIN)/python -m pytest -m 'long and alone' tests/system

# While writing code: no lint, no tests of more than a second, none of the whole system.
quick: .venv/installed-dev
	$(BIN)/python -m pytest -n auto --dist loadfile -m 'not slow and not long and not image' tests/es_service tests/laws tests/workers

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

# What an interrupted command has left of .venv is made anew.
ifneq ($(wildcard .venv/installed .venv/installing),.venv/installed)
.PHONY: $(BIN)/python
endif

# Without the system's package for it, Debian's Python cannot make .venv.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Python 3.11 or newer is needed; try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@rm -rf .venv
ifneq ($(UV),)
	@$(UV) venv --quiet --seed --python "$$($(PYTHON) -c 'import sys; print(sys.executable)')" .venv
else
	@$(PYTHON) -m venv .venv || { rm -rf .venv; \
	  echo "$(PYTHON) could not make .venv, for the reason above; on Debian and Ubuntu install python3-venv" \
	  "(of another Python than the system's: python3.12-venv, say), then again: make $(MAKECMDGOALS)"; exit 1; }
endif

ifneq ($(UV),)
INSTALL := $(UV) pip install --python $(BIN)/python
FAILED = "$(UV) failed, for the reason above; to install with pip instead: make UV= $(MAKECMDGOALS)"
else
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check
FAILED = "pip failed, for the reason above; then again: make $(MAKECMDGOALS)"
endif

# $(call install,what,packages)
define install
	@echo "installing $(2) with $(firstword $(notdir $(UV)) pip), as constraints.txt pins them; what it has not cached is" \
	  "downloaded from the package index that it is configured with"
	@touch .venv/installing; began=$$(date +%s); $(INSTALL) --quiet -c constraints.txt -e '$(1)'; failed=$$?; \
	  rm .venv/installing; [ $$failed = 0 ] || { echo $(FAILED); exit 1; }; \
	  echo "installed in $$(($$(date +%s) - began)) s"
	@touch .venv/installed
endef

.venv/installed: $(BIN)/python pyproject.toml constraints.txt
	$(call install,.,$(PACKAGES))

.venv/installed-dev: $(BIN)/python pyproject.toml constraints.txt
	$(call install,.[dev],$(PACKAGES_DEV))
	@touch $@

clean:
	rm -rf .venv build *.egg-info
