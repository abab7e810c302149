# Two commands do everything: `make grasp` and `make test`. Each first sets up what is missing.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
EGL_PACKAGES := libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0
# Python compiles each module when it is first imported. Compiling all of them here takes longer than the installation.
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile
# PyPI's PyTorch for Linux brings 4 GB of CUDA libraries. Where this index can't be reached, pip's own has to do.
CPU_INDEX := https://download.pytorch.org/whl/cpu
TORCH := $(shell grep -om1 'torch>=[^"]*' pyproject.toml)

# Tests of all lines of the safety monitor and the limits. `make test` runs them once, and counts the lines.
COVERED := tests/control/test_safety.py tests/control/test_limits.py

.PHONY: grasp test run-tests check-types test-docs test-lerobot test-lowest docs wheel setup setup-dev format clean

grasp: setup
	$(BIN)/gripper-force grasp $(ARGS)

test: setup-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(MAKE) --jobs=2 run-tests check-types
	$(BIN)/coverage run -m pytest -q $(COVERED)
	$(BIN)/coverage report

run-tests:
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto --dist worksteal $(or $(ARGS),$(COVERED:%=--ignore=%))

# Takes only the time that the tests leave: some of them run in real time.
check-types:
	nice -n 19 $(BIN)/mypy
	NO_MKDOCS_2_WARNING=1 nice -n 19 $(BIN)/mkdocs build --quiet

# Runs the commands of all pages; `make test` runs only those of short pages.
test-docs: setup-dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto -m '' tests/docs $(ARGS)

# LeRobot 0.6.1 needs Python 3.12: make test-lerobot LEROBOT=0.6.1 PYTHON=python3.12
LEROBOT ?= 0.4.4
LEROBOT_VENV := .venv-lerobot-$(LEROBOT)
test-lerobot:
	test -x $(LEROBOT_VENV)/bin/pip || $(PYTHON) -m venv $(LEROBOT_VENV)
	$(LEROBOT_VENV)/bin/pip install --quiet --disable-pip-version-check --no-compile \
		--editable '.[dev,lerobot,oak,report,sim,train]' \
		--editable integrations/lerobot_robot_gripper_force --editable integrations/lerobot_camera_oak \
		lerobot==$(LEROBOT)
	$(LEROBOT_VENV)/bin/pytest -m lerobot tests/jobs/exports integrations $(ARGS)

# The tests with the oldest versions that pyproject.toml allows. Typer's warns of Click's newest.
LOWEST_VENV := .venv-lowest
test-lowest:
	test -x $(LOWEST_VENV)/bin/pip || $(PYTHON) -m venv $(LOWEST_VENV)
	$(PYTHON) scripts/lowest_versions.py > $(LOWEST_VENV)/lowest.txt
	$(LOWEST_VENV)/bin/pip install --quiet --disable-pip-version-check --no-compile \
		--editable '.[dev,engines,oak,report,sim,train]' --constraint $(LOWEST_VENV)/lowest.txt
	OMP_NUM_THREADS=1 $(LOWEST_VENV)/bin/pytest -n auto -W ignore::DeprecationWarning $(ARGS)

docs: setup-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo open build/site/index.html

# sdist and wheel in dist/
wheel: setup-dev
	$(BIN)/python -m hatchling build

format: setup-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

setup: $(VENV)/installed
setup-dev: $(VENV)/installed-dev

$(VENV)/installed: EXTRAS := report,sim,train
$(VENV)/installed-dev: EXTRAS := dev,engines,oak,report,sim,train
$(VENV)/installed $(VENV)/installed-dev: pyproject.toml scripts/system-packages
	PYTHON=$(PYTHON) scripts/system-packages $(EGL_PACKAGES)
	test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	test "$$(uname)" != Linux || $(PIP) --retries 0 --timeout 10 --index-url $(CPU_INDEX) --no-deps '$(TORCH)' 2>/dev/null || true
	$(PIP) --editable '.[$(EXTRAS)]'
	touch $(VENV)/installed $@  # what is for development contains the rest

clean:
	rm -rf $(VENV) .venv-*
