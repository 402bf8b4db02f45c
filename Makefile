# The two commands a newcomer needs: `make run` and `make test`. Each sets up .venv by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# One more than two processors: many tests wait for a process that they started.
JOBS ?= 3
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# One thread in each BLAS: the matrices here are small, and workers run side by side.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
# The tests start hundreds of processes: each would compile the whole package anew where this forbids to keep that.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run paper test test-all test-quick lint types imports unit test-slow kills faults fuzz bench pins licences docs release-check clean help

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

# Files are compared with their digests. The list names all that is needed, so nothing besides is looked for: no digest
# is taken for an editable package, and the build tools of gbid come from the list, too. uv takes a tenth of the
# processor time of pip, which brings the pinned uv where there is none; where that fails, pip installs all.
PINNED := --no-deps --require-hashes --requirement
INSTALL = $$(command -v uv > /dev/null && echo uv pip install --python $(BIN)/python || \
	{ test -x $(BIN)/uv && echo $(BIN)/uv pip install --python $(BIN)/python; } || \
	echo $(BIN)/python -m pip install --no-compile --progress-bar off)

$(VENV)/.installed: pyproject.toml requirements.txt
	@echo "making an environment in $(VENV)"
	@$(PYTHON) -m venv $(VENV)
	@sed '/^# ---- tests and docs/,$$d' requirements.txt > $(VENV)/needed.txt
	@sed -n '/^uv==/,/^[^ u]/{/^uv==/p;/^ /p;}' requirements.txt > $(VENV)/uv.txt
	@command -v uv > /dev/null || { echo "bringing uv, which installs faster than pip"; \
		$(BIN)/python -m pip install --quiet --no-compile $(PINNED) $(VENV)/uv.txt || echo "pip takes its place: a minute or two"; }
	@echo "installing $$(grep -c == $(VENV)/needed.txt) packages (600 MB)"
	@$(INSTALL) $(PINNED) $(VENV)/needed.txt
	@$(INSTALL) --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.installed-tools: $(VENV)/.installed
	@echo "installing $$(grep -c == requirements.txt) packages for tests and pages"
	@$(INSTALL) $(PINNED) requirements.txt
	@touch $@

run: $(VENV)/.installed  ## the main job: rig, prefilter, fit, cross-validate, the picture
	$(BIN)/gbid run experiments/quickstart.yaml

test: lint imports  ## everything that must hold before a change lands, but for what `make test-all` adds
	$(MAKE) --jobs 2 types unit

test-all: MARKED := not slow
test-all: lint imports  ## the same with the executed pages, the public benchmarks, and runs of benchmarks
	$(MAKE) --jobs 2 types unit MARKED="$(MARKED)"

lint: $(VENV)/.installed-tools  ## ruff: style and common faults
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-tools  ## mypy, strict
	$(BIN)/mypy

imports: $(VENV)/.installed-tools  ## the layers of the house plan
	$(BIN)/lint-imports

# Thousands of small files are written through to the disk, which tests wait for. They fit into memory where it has room.
ROOM = $(shell df -Pk /dev/shm 2>/dev/null | awk 'NR == 2 && $$4 > 2000000 {print "TMPDIR=/dev/shm"}')

MARKED := not slow and not whole
unit: $(VENV)/.installed-tools  ## the tests, warnings as errors
	$(ROOM) $(BIN)/pytest -n $(JOBS) --dist worksteal -m "$(MARKED)"

# The heart: a recording, its fit, surfaces, gains, and one experiment through the command line.
QUICK := tests/house tests/recording/test_recording.py tests/recording/test_recording_store.py tests/identify/test_fit.py \
	tests/identify/test_predictor.py tests/lpv/test_lpv.py tests/lpv/test_outliers_and_terms.py tests/control/test_close_loop.py \
	tests/lpv/test_lpv_fit.py::test_data_without_errors_give_the_table_of_the_paper_back \
	tests/control/test_tune.py::test_the_papers_design_is_found_again \
	tests/cli/test_cli.py::test_run_prints_data_on_stdout_and_progress_on_stderr
LEFT_TO_TEST := $(foreach name,docs benchmarks packaging old_files fuzz,--ignore=tests/house/test_$(name).py)

test-quick: $(VENV)/.installed-tools  ## style, layers, and the tests of the heart, in less than a minute
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/pytest -q -n $(JOBS) --dist worksteal $(LEFT_TO_TEST) $(QUICK)

test-slow: $(VENV)/.installed-tools  ## the long studies
	$(BIN)/pytest -m slow -s

fuzz: $(VENV)/.installed-tools  ## damaged files of all kinds for an hour, then 5000 wrong calls of the public names; MINUTES=, COUNT=, SEED=, JOBS=, REPLAY=SEED/NUMBER, FIGURES= or AGAIN=docs/fuzz.json
	PYTHONPATH=$(CURDIR):$(CURDIR)/tests/support $(BIN)/python -m fuzzing --jobs $(JOBS) $(if $(MINUTES),--minutes $(MINUTES)) \
		$(if $(COUNT),--count $(COUNT)) $(if $(SEED),--seed $(SEED)) $(if $(REPLAY),--replay $(REPLAY)) $(if $(FIGURES),--output $(FIGURES)) $(if $(AGAIN),--again $(AGAIN))
	$(if $(REPLAY)$(AGAIN),,PYTHONPATH=$(CURDIR):$(CURDIR)/tests/support $(BIN)/python -m fuzzing.calls $(if $(SEED),--seed $(SEED)))

# A fit that did not converge (exit code 4) is left out of what follows and named there.
PAPER := experiments/theisen2016.yaml
paper: $(VENV)/.installed  ## the whole paper: campaign to impacts, report, figures and tables, its figures beside ours
	$(BIN)/gbid run $(PAPER) || test $$? -eq 4
	$(BIN)/gbid paper $(PAPER) --overwrite --format pdf --format svg --format png --output docs/reproduction.json

bench: $(VENV)/.installed  ## how fast a fit is, beside scipy and CasADi; writes the table that the docs show
	$(BIN)/python -m tests.benchmarks.fit_speed --output docs/benchmarks.json
	$(BIN)/python -m tests.benchmarks.tune_speed --output docs/tune-speed.json
	$(BIN)/python -m tests.benchmarks.tune_seeds
	$(BIN)/python -m tests.benchmarks.nonlinear_speed --output docs/nonlinear-speed.json
	$(BIN)/python -m tests.benchmarks.campaign_speed --output docs/campaign-speed.json
	$(BIN)/python -m tests.benchmarks.campaign_bill --output docs/campaign-bill.json
	$(BIN)/python -m tests.benchmarks.scaling --output docs/scaling.json
	$(BIN)/python -m tests.benchmarks.lanes

kills: $(VENV)/.installed  ## kill gbid at 1000 random instants, in all verbs, and count what is lost, made twice or left
	$(BIN)/python -m tests.benchmarks.kills --output docs/kills.json

faults: $(VENV)/.installed-tools  ## failing writes and locks, a jumping clock, SIGTERM and runs side by side, in all verbs; Linux
	$(BIN)/python -m tests.benchmarks.faults

pins: $(VENV)/.installed-tools  ## the list of pinned versions anew, with changed dependencies; UPGRADE=--upgrade for the newest
	PYTHONPATH=$(CURDIR)/tests/support PATH=$(CURDIR)/$(BIN):$(PATH) $(BIN)/python tests/support/pins.py $(UPGRADE)

licences: $(VENV)/.installed-tools  ## docs/licences.csv, the table of licences, from the metadata of the packages
	PYTHONPATH=$(CURDIR)/tests/support $(BIN)/python tests/support/licences.py

docs: $(VENV)/.installed-tools  ## the pages, code blocks executed, warnings as errors
	$(BIN)/sphinx-build -W --keep-going -b html docs docs/_build/html

release-check: $(VENV)/.installed-tools  ## wheel and source archive built, the wheel tried in fresh environments: each Python, newest and lowest dependencies; TRY=--here or --offline
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist .
	$(BIN)/python tests/support/try_release.py dist $(TRY)

clean:  ## remove what was built, keep results
	rm -rf $(VENV) docs/_build build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
