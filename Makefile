# Every target works from a fresh clone: it first sets up what it needs.
PYTHON ?= python3
VENV ?= .venv
# A clone of the Modelica Standard Library.
MSL ?= ../ModelicaStandardLibrary
SEALED ?= ../shared/data/sealed
SEALED_ABROAD ?= ../shared/data/sealed_abroad
# The blind check: a folder outside this one for what the diagnosis must not see.
LABELS ?= ../blind-labels
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEVELOPER := $(VENV)/.developer
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

ACTUATOR := FixedShaft FreeShaft EccentricLoad
PENDULUM := build/fmus/TorqueDriven.fmu build/fmus/PositionDriven.fmu
# The actuator and its speed controller as separate FMUs, to be coupled (docs/coupled.md).
COUPLED := build/fmus/EccentricLoadPlant.fmu build/fmus/SpeedController.fmu
FMUS := $(ACTUATOR:%=build/fmus/%.fmu) $(PENDULUM)
STEPPER := $(shell find src -name "*.[ch]")
MODELICA := $(shell find modelica -name '*.mo')
EXPORT := $(shell find fmu_build -name '*.py' -o -name '*.[ch]')
RIG := $(shell find benchmarks/virtual_rig -type f -name '*.[pc]*')

FORCE_FEEDBACK := campaigns/force_feedback
LINEAR := $(foreach stage,linear_step bearing linear,--stage $(stage))
ROWS := $(foreach row,10 15 20 30,row_$(row)_equal row_$(row)) rows
FRICTION := $(foreach stage,bearing linear $(ROWS) standstill,--stage $(stage))

.PHONY: all setup fmus coupled test test-all test-reference test-page lint identify identify-linear identify-friction identify-emps identify-go1 identify-double-pendulum identify-robot identify-credibility identify-temperature-lab paper diagnose diagnose-emps diagnose-go1 diagnose-double-pendulum diagnose-robot sealed sealed-abroad blind blind-publish blind-verify blind-agreement designed-runs bench coverage fuzz kills failing-writes memory standard-library modelica-by-example compliance screenshots docs release clean
all: identify

setup: $(READY)
$(READY): pyproject.toml setup.py constraints.txt $(STEPPER)
	$(PYTHON) -m venv $(VENV)
	$(PIP) --editable ".[build]"
	@touch $@
$(DEVELOPER): $(READY)
	$(PIP) --editable ".[dev]"
	$(PIP) --no-deps gemseo-fmu # FMUs of OpenModelica, for tests
	@touch $@

fmus: $(FMUS)
build/fmus/%.fmu: $(MODELICA) $(EXPORT) | $(READY)
	$(BIN)/fmuid build modelica/Drives/Setups/$*.mo Drives.Setups.$* --out $(@D)
	@touch $@

$(PENDULUM): build/fmus/%.fmu: $(MODELICA) $(EXPORT) | $(READY)
	$(BIN)/fmuid build modelica/Pendulum/Setups/$*.mo Pendulum.Setups.$* --root modelica --out $(@D)
	@touch $@

coupled: $(COUPLED)
build/fmus/SpeedController.fmu: $(MODELICA) $(EXPORT) | $(READY)
	$(BIN)/fmuid build modelica/Drives/Signals/SpeedController.mo Drives.Signals.SpeedController --out $(@D)
	@touch $@

$(FORCE_FEEDBACK)/measurements.h5: $(FORCE_FEEDBACK)/rig.toml $(RIG) | $(READY)
	$(BIN)/python -m benchmarks.virtual_rig $(FORCE_FEEDBACK)

identify: $(FMUS) $(FORCE_FEEDBACK)/measurements.h5
	$(BIN)/fmuid identify $(FORCE_FEEDBACK) --out runs/force_feedback

identify-linear: $(FMUS) $(FORCE_FEEDBACK)/measurements.h5
	$(BIN)/fmuid identify $(FORCE_FEEDBACK) $(LINEAR) --out runs/linear

identify-friction: $(FMUS) $(FORCE_FEEDBACK)/measurements.h5
	$(BIN)/fmuid identify $(FORCE_FEEDBACK) $(FRICTION) --out runs/friction

diagnose: $(FMUS) $(FORCE_FEEDBACK)/measurements.h5
	$(BIN)/fmuid diagnose $(FORCE_FEEDBACK) --out runs/diagnosis

# Recipes of single campaigns: measurements, identify-NAME and diagnose-NAME.
include $(sort $(wildcard campaigns/*/targets.mk))

sealed: | $(READY)
	$(BIN)/python -m benchmarks.sealed $(SEALED) --out sealed --page docs/sealed.md

# Rigs of other kinds, each with its own plain Modelica model.
sealed-abroad: | $(READY)
	$(BIN)/python -m benchmarks.sealed $(SEALED_ABROAD) --abroad --out sealed --page docs/sealed.md

# Random rigs, drawn from SEED and diagnosed: 100 cases of a rehearsal, 400 of the check. Continues where it was interrupted.
# FIRST=100 COUNT=400: the check alone; COUNT=60 ONLY=varies: so many of one stratum; WORKERS=2: cases in parallel.
# LABELS: a folder outside this one.
blind: | $(READY)
	@test -n "$(SEED)" || { echo "SEED=...: an integer that was not used before"; exit 2; }
	$(BIN)/python -m benchmarks.blind run $(SEED) --labels $(LABELS) $(FIRST:%=--first %) $(COUNT:%=--count %) \
	  $(ONLY:%=--only %) $(WORKERS:%=--workers %)

# Afterwards: commit what is published of the seed, and the page.
blind-publish: | $(READY)
	$(BIN)/python -m benchmarks.blind publish $(SEED) --labels $(LABELS)
	$(BIN)/python -m benchmarks.blind page

# Recompute docs/blind.md from what is committed, and the logs of REGENERATE cases of each seed from the seed.
REGENERATE ?= 5
blind-verify: | $(READY)
	$(BIN)/python -m benchmarks.blind verify --regenerate $(REGENERATE)

# Do 50 random plants and their models agree? Before any diagnosis.
blind-agreement: | $(READY)
	$(BIN)/python -m benchmarks.blind agreement $(or $(SEED),1)

# By how much designed runs of the actuator reduce standard errors.
designed-runs: $(DEVELOPER) $(FMUS)
	$(BIN)/python -m benchmarks.designed_actuator

# How often 95 % intervals contain the truth: the linear stage under white and coloured noise, and a light model under
# thirteen kinds of noise and wrong models. Fifteen minutes.
DRAWS ?= 200
coverage: $(FMUS) $(FORCE_FEEDBACK)/measurements.h5
	$(BIN)/python -m benchmarks.interval_coverage $(FORCE_FEEDBACK) linear $(DRAWS)
	$(BIN)/python -m benchmarks.interval_coverage $(FORCE_FEEDBACK) linear $(DRAWS) coloured
	$(BIN)/python -m benchmarks.interval_coverage $(DRAWS)

lint: $(DEVELOPER)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python benchmarks/plain_english.py

# In two processes, each file in one of them, so that its fixtures are made once.
ABREAST := --numprocesses 2 --dist loadfile

test: lint
	$(BIN)/pytest $(ABREAST) -m "not slow"

# The tests of the actuator on its models in pure Python, as where there is no C compiler.
test-reference: $(DEVELOPER)
	$(BIN)/pytest --reference-models tests/reference -m "not slow"

# The local page alone, in Chromium; these tests are skipped where it is missing.
test-page: $(DEVELOPER)
	$(BIN)/pytest tests/page

test-all: lint
	$(BIN)/pytest $(ABREAST)

# 10,000 damaged files of each kind; 200 kills, 30 of them of a diagnosis, some in the last 50 ms; a failure of every
# operation on a file: docs/nothing_lost.md.
fuzz: $(DEVELOPER)
	FMUID_FUZZ=10000 $(BIN)/pytest tests/errors/test_fuzz.py

kills: $(DEVELOPER)
	FMUID_KILLS=200 $(BIN)/pytest tests/simulation/test_survival.py -k killed -s

# Peak memory of 10,000 runs and of a history with 10^6 evaluations: ten minutes.
memory: $(DEVELOPER)
	$(BIN)/python benchmarks/memory.py

failing-writes: $(DEVELOPER)
	FMUID_EVERY=1 $(BIN)/pytest tests/simulation/test_failing_writes.py -s

# Every peer has its own environment; one that cannot be set up is listed as missing.
PEERS := aixcalibuha modestpy mujoco pypesto sundae
PEER_PYTHON ?= $(PYTHON)
build/peers/%/.ready: benchmarks/peers/%.txt
	$(PEER_PYTHON) -m venv build/peers/$*
	build/peers/$*/bin/python -m pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

bench: $(DEVELOPER) $(FMUS) $(PENDULUM) $(FORCE_FEEDBACK)/measurements.h5
	-$(MAKE) --keep-going $(PEERS:%=build/peers/%/.ready)
	MODELICAPATH=$(MSL):$$MODELICAPATH $(BIN)/python benchmarks/bench.py

# The Modelica Standard Library's examples against its reference results. ROOT: the folder that contains its Modelica folder;
# REFERENCE: a folder of the Modelica Association's reference results. Continues where it was interrupted.
standard-library: $(DEVELOPER)
	@test -d "$(ROOT)/Modelica" || { echo "ROOT=$(ROOT): no Modelica folder in it"; exit 2; }
	@test -d "$(REFERENCE)/Modelica" || { echo "REFERENCE=$(REFERENCE): no reference results in it"; exit 2; }
	@mkdir -p build
	$(BIN)/python benchmarks/standard_library.py $(ROOT) $(REFERENCE) --results build/standard_library.json \
	  --page docs/standard_library.md

# The models of the book "Modelica by Example". BOOK: its folder; ROOT: that of the Standard Library 3.2.3, which it uses.
modelica-by-example: $(DEVELOPER)
	@test -f "$(BOOK)/text/specs.py" || { echo "BOOK=$(BOOK): no text/specs.py in it"; exit 2; }
	@test -d "$(ROOT)/Modelica" || { echo "ROOT=$(ROOT): no Modelica folder in it"; exit 2; }
	@mkdir -p build
	$(BIN)/python -m benchmarks.modelica_by_example $(BOOK) $(ROOT) --results build/modelica_by_example.json \
	  --page docs/modelica_by_example.md

# The public Modelica-Compliance suite. SUITE: a clone of https://github.com/modelica/Modelica-Compliance.
compliance: $(DEVELOPER)
	@test -d "$(SUITE)/ModelicaCompliance" || { echo "SUITE=$(SUITE): no ModelicaCompliance folder in it;" \
	  "git clone https://github.com/modelica/Modelica-Compliance"; exit 2; }
	$(BIN)/python -m benchmarks.compliance $(SUITE) --page docs/modelica_compliance.md

# Changes that no test of the numerical core detects: build/mutation/survivors.md. MODULE=features: only those of this module.
mutation: $(DEVELOPER)
	$(PIP) --editable ".[mutation]"
	.ci/mutation $(BIN) $(MODULE)

# Pictures of reports in docs/figures; needs a browser: Chromium or Chrome.
screenshots: $(DEVELOPER)
	$(BIN)/python -m docs.pictures.reports

# Pages in build/site; a warning is an error.
docs: $(READY)
	$(PIP) --editable ".[build,docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Checks the version, changelog and pages, runs CHECKS, builds the sdist and the wheels in dist/, tries them and tags the
# commit.
CHECKS ?= test docs
release: $(READY)
	CHECKS="$(CHECKS)" PYTHON=$(PYTHON) .ci/release

clean:
	rm -rf build runs $(VENV)
