# lfpiv: install, run the main job on the sample, test.
#
#   make            install into .venv and go from the sample's raw images to velocity vectors and pictures
#   make flow CONFIG=rig.yaml DATA=images OUT=results A=img_a B=img_b      the same on your own images
#   make test       quick tests, in two minutes      make test-thorough   those that take a second or more each
#   make test-all   all tests, the slow ones too
#   make test-interpreted   a few tests whose kernels run uncompiled, readable twins in place of vectorised loops
#   make check      ruff and mypy         make bench      speed as ratios against a stated peer
#   make fuzz       hours of damaged, edited and made-up files for the readers, CASES=1000000 of each kind
#   make docs       the documents, with pictures from the sample, into out/docs/
#
# DATA holds white.tif, dark.tif, board.tif and the images A.tif and B.tif. METHOD is auto (volumes or particles, by how
# many tracers there are), volumes, particles or both. Safe under -j; a failed step leaves no target.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# What the commands need, and what the tests, checks and documents need beside it: two thirds of all.
CORE := $(VENV)/core
INSTALLED := $(VENV)/installed
LFPIV := $(BIN)/lfpiv

CONFIG ?= configs/sample.yaml
DATA ?= sample_data
OUT ?= out/sample
A ?= pair_a
B ?= pair_b
IMAGES ?= $(DATA)/$(A).tif $(DATA)/$(B).tif
PHOTOGRAPHS := $(DATA)/white.tif $(DATA)/dark.tif $(DATA)/board.tif
# The sample is measured both ways, and its config says what is true; of others, the program chooses.
METHOD ?= $(if $(filter configs/sample.yaml,$(CONFIG)),both,auto)
MEASURED := $(if $(filter volumes both,$(METHOD)),report) $(if $(filter particles both,$(METHOD)),report_particles)
REPORTS := $(if $(filter configs/sample.yaml,$(CONFIG)),$(MEASURED))

.DELETE_ON_ERROR:
.PHONY: flow install test test-thorough test-all test-interpreted check format docs bench fuzz clean
.SECONDARY:

flow: $(OUT)/run.json $(REPORTS:%=$(OUT)/%/flow.json)

install: $(INSTALLED)

# Python compiles what it imports; pip would compile all.
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

$(CORE): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) --constraint requirements.lock --editable ".[report]"
	@touch $@

$(INSTALLED): $(CORE)
	$(PIP_INSTALL) --requirement requirements.lock
	@touch $@

# Steps that are complete and made alike are kept by the command itself.
$(OUT)/run.json: $(CONFIG) $(PHOTOGRAPHS) $(IMAGES) | $(CORE)
	@mkdir -p $(@D)
	$(LFPIV) run $(CONFIG) $(IMAGES) --white $(DATA)/white.tif --dark $(DATA)/dark.tif --board $(DATA)/board.tif \
	    --method $(METHOD) --output $(OUT) --overwrite

$(OUT)/report/flow.json: $(CONFIG) $(OUT)/run.json | $(CORE)
	$(LFPIV) validate flow $(CONFIG) --vectors $(OUT)/vectors.vtkhdf --output $(@D) --overwrite

$(OUT)/report_particles/flow.json: $(CONFIG) $(OUT)/run.json | $(CORE)
	$(LFPIV) validate flow $(CONFIG) --vectors $(OUT)/tracks_grid.vtkhdf --output $(@D) --overwrite

# Two processes: the first run is all compilation, which takes one core each.
test: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

test-thorough: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile -m thorough

test-all: $(INSTALLED)
	$(BIN)/python -m pytest -m "slow or thorough or not slow"

test-interpreted: $(INSTALLED)
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -m "not slow" tests/test_interpreted.py

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(INSTALLED)
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d out/doctrees docs out/docs

bench: $(INSTALLED)
	$(BIN)/python -m benchmarks

CASES ?= 1000000
fuzz: $(INSTALLED)
	$(BIN)/python -m benchmarks fuzz --cases $(CASES) --failures out/fuzz

clean:
	rm -rf out docs/_generated
