# Two commands are enough on a fresh machine: `make fly` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

.PHONY: fly test slow lint bench clean setup

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $(READY)

setup: $(READY)

fly: $(READY)  ## fly the simulated firmware with wrong constants and watch them being corrected
	$(BIN)/crazyem fly --trajectory excite --duration 20 --record flight.mcap --json flight.json

test: $(READY)  ## everything that is not marked slow
	$(BIN)/python -m pytest -q -n 2

slow: $(READY)  ## the long ones: many seeds, many flights
	$(BIN)/python -m pytest -q -n 2 -m slow

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache
