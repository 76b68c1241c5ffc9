# The README's two commands are `make demo` and `make test`. Each makes .venv, installs and runs.

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

# python3 where it is 3.11-3.13 (for which there are ROS wheels) and can make a venv, else the
# newest such python on PATH, else anything newer. `make PYTHON=...` overrides.
SUITS = import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= $(1))
PYTHON ?= $(shell \
  for p in python3 python3.13 python3.12 python3.11; do \
    $$p -c '$(call SUITS,(3, 13))' 2>/dev/null && { echo $$p; exit; }; \
  done; \
  for p in python3 python3.14 python3.15; do \
    $$p -c '$(call SUITS,(3, 99))' 2>/dev/null && { echo $$p; exit; }; \
  done)

# Else every process of the tests compiles them again: a third of the time that collecting them takes.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-slow check lint docs benchmarks clean help
.DELETE_ON_ERROR:

help:
	@echo 'make demo   run the chain on the shipped bags'
	@echo 'make test   run the quick tests that need no ROS'
	@echo 'make test-slow  run the tests that need no ROS and take longer'
	@echo 'make check  ruff, mypy and make test'
	@echo 'make docs   build the site, running every block of its tutorials'
	@echo 'make benchmarks  run them all: one JSON file each in benchmarks/results'
	@echo 'make clean  remove what these made'

demo: $(VENV)/.demo
	$(BIN)/nlsid demo

# One process a core, each with one thread for its matrices: more threads than cores only wait.
test: $(VENV)/.test
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal --durations 25

test-slow: $(VENV)/.test
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m 'slow and not (ros or colcon or coq)' -n auto --dist loadfile --durations 25

check: lint test

# make benchmarks DATA=DIR: also those on recordings that do not ship with the project.
benchmarks: $(VENV)/.bench
	$(BIN)/python -m benchmarks $(if $(DATA),--data $(DATA))

lint: $(VENV)/.test
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# Every page is read and run again: what the site shows is what this checkout does.
docs: $(VENV)/.docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --fresh-env --quiet --builder html docs build/site
	@echo 'wrote build/site/index.html'

clean:
	rm -rf .venv .venv-* nlsid-demo build install log *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Editable, so that both commands run the checkout and an edit needs no second install.
# $(call install,EXTRAS): with ROS where its wheels exist, else without, said in one line.
define install
@echo 'nlsid: installing into $(VENV), about two minutes the first time'
@$(PIP) install --editable '.[ros,$(1)]' || { \
  echo 'nlsid: no ROS wheels for this Python or platform; installing without (nothing live runs).'; \
  $(PIP) install --editable '.[$(1)]'; }
touch $@
endef

$(VENV)/.demo: pyproject.toml setup.py | $(BIN)/python
	$(call install,identify$(COMMA)report)

$(VENV)/.test: pyproject.toml setup.py | $(BIN)/python
	$(call install,report$(COMMA)export$(COMMA)sim$(COMMA)fleet$(COMMA)test)

$(VENV)/.docs: pyproject.toml setup.py | $(BIN)/python
	$(call install,report$(COMMA)docs)

$(VENV)/.bench: pyproject.toml setup.py | $(BIN)/python
	$(call install,report$(COMMA)sim$(COMMA)bench)

COMMA := ,

$(BIN)/python:
	@[ -n "$(PYTHON)" ] || { echo 'nlsid: needs Python 3.11 or newer with venv (Debian, Ubuntu: apt install python3-venv)'; exit 1; }
	$(PYTHON) -m venv $(VENV)
