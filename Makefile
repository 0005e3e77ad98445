# Two commands are enough on a fresh machine: `make fly` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
FLIES  := $(VENV)/.installed
READY  := $(VENV)/.ready
WARM   := $(VENV)/.compiled

# Four processes for two cores, because some wait for sockets and clocks. One that is done takes over what others have
# not begun: a long test at the head of one's list does not keep the rest waiting.
SHARED := -n 4 --dist worksteal

# Modules are compiled once: the tests start some hundred processes, each of which would compile all of them again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: fly test slow slow-fixed lint bench docs concealed paper paper-docs cfclient-test simulators clean \
	setup compiled oldest

INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --editable

$(FLIES): pyproject.toml  # what a flight needs; modules are compiled when they are imported
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) '.[plots,live]'
	touch $(FLIES)

$(READY): pyproject.toml  # and what developers need: all of it at once
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) '.[dev]'
	touch $(FLIES) $(READY)

$(WARM): $(READY)  # once: what is compiled stays on the disk
	$(BIN)/python tests/compile_first.py
	touch $(WARM)

setup: $(READY)

compiled: $(WARM)

oldest:  ## an environment of the lower bounds of pyproject.toml, as continuous integration tests it
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python --resolution lowest-direct --editable '.[test]'
	touch $(FLIES) $(READY)

fly: $(FLIES)  ## fly the simulated firmware with wrong constants and watch them being corrected
	$(BIN)/crazyem fly --scenario firmware_sim/scenarios/payload.toml --trajectory excite --duration 12 \
		--record flight.mcap --json flight.json

test: $(WARM)  ## everything that is not marked slow
	$(BIN)/python -m pytest -q $(SHARED)

slow: $(WARM)  ## the long ones: many seeds, many flights, and made-up examples that are many and new
	$(BIN)/python -m pytest -q $(SHARED) -m "slow or hypothesis" --hypothesis-profile new

slow-fixed: $(WARM)  ## the long ones without those of the night
	$(BIN)/python -m pytest -q $(SHARED) -m "slow and not nightly"

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY)  ## speed against named peers (those installed: pip install -e '.[bench]')
	$(BIN)/python benchmarks/speed.py

docs: $(READY)  ## the pages as a site, with strict links, and the notebooks
	$(BIN)/mkdocs build --strict
	$(BIN)/python -m pytest -q -m slow tests/test_docs.py

concealed: $(READY)  ## physics hidden in the simulator, and whether diagnose finds it; goes on where it was stopped
	$(BIN)/python -m benchmarks.concealed draw --cases 320 --seed 2048 --out out/concealed
	$(BIN)/python -m benchmarks.concealed fly --out out/concealed
	$(BIN)/python -m benchmarks.concealed diagnose --out out/concealed
	$(BIN)/python -m benchmarks.concealed score --out out/concealed --write-docs

paper: $(READY)  ## Zhao's paper again: its tables and figures, by its method and by ours; goes on where it was stopped
	$(BIN)/crazyem paper --out paper

paper-docs: paper  ## the numbers of that run into docs/explanation/paper.md, and the drift test
	$(BIN)/python benchmarks/paper_pages.py paper/results.json --small tests/crazyem/expectations/paper_small.json

simulators:  ## our files in real simulators, in an environment of their own
	$(PYTHON) -m venv .venv-simulators
	.venv-simulators/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[test]' \
		'crazyflow>=0.4' 'mujoco>=3.2' 'rotorpy>=3.0' 'pybullet>=3.2.7'
	.venv-simulators/bin/python -m pytest -q -m slow tests/crazyem/test_simulators_real.py

cfclient-test: $(READY)  ## the graphical client against the simulator, in an environment of its own
	$(PYTHON) -m venv .venv-cfclient
	.venv-cfclient/bin/python -m pip install --quiet --disable-pip-version-check 'cfclient==2026.8.1'
	CFCLIENT_PYTHON=.venv-cfclient/bin/python $(BIN)/python -m pytest -q -m slow tests/firmware_sim/test_cfclient.py

clean:
	rm -rf $(VENV) .venv-cfclient .venv-simulators .pytest_cache .mypy_cache .ruff_cache
