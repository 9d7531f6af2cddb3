# Every target works from a fresh clone: it sets up what it needs first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
FMUID := $(BIN)/fmuid --
READY := $(VENV)/.ready
EMPS ?= ../shared/data/emps
CAMPAIGN := campaigns/force_feedback
FMUS := build/fmus

.PHONY: all setup fmus measurements test test-all lint identify identify-linear identify-friction identify-emps \
        diagnose bench clean
all: identify

setup: $(READY)
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	touch $@

clean:
	rm -rf build runs $(VENV)
