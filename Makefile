# hiersched: everything a reader needs, from a fresh clone with Python, make and git.
#
#   make paper              every figure and table of the paper
#   make teleop             the study of what knowing the task is worth
#   make teleop-learning    that of what learning adds
#   make test               the tests
#   make VENV=/tmp/v test   the same in another virtual environment
#   make PYTHON=python3.12  another interpreter

PYTHON ?= python3
VENV ?= .venv
CORES ?= 2
PIP_ARGS ?=
# As in pyproject.toml.
OLDEST_NUMBA := 0.61.0

STAMP := $(VENV)/.installed
BIN := $(abspath $(VENV))/bin
# `python` and `snakemake` are those of the environment.
# One thread per process: the workflow runs jobs side by side, and the bits of a
# matrix product depend on the number of threads.
RUN := env PATH="$(BIN):$$PATH" OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 PYTHONHASHSEED=0

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: oldest pythons help install paper smoke readme docs site gains test nightly mutants lint format bench bench-short clean distclean teleop teleop-learning

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-15s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(STAMP)  ## create the virtual environment (the other targets do it when needed)

$(STAMP): constraints.txt pyproject.toml
	@command -v "$(PYTHON)" >/dev/null 2>&1 || { \
	  echo "hiersched needs Python 3.11 or newer, and '$(PYTHON)' was not found: make PYTHON=/path/to/python" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "hiersched needs Python 3.11 or newer, and '$(PYTHON)' is $$("$(PYTHON)" -V 2>&1): make PYTHON=/path/to/python" >&2; exit 1; }
	@test -x "$(VENV)/bin/python" || "$(PYTHON)" -m venv "$(VENV)"
	"$(VENV)/bin/python" -m pip install --quiet $(PIP_ARGS) -c constraints.txt -e '.[dev]'
	@touch "$@"

paper: $(STAMP)  ## every figure and table of the paper (results/paper)
	$(RUN) snakemake --cores $(CORES) --config scenarios='[paper]'

smoke: $(STAMP)  ## the same pipeline, small enough for a few minutes (results/smoke)
	$(RUN) snakemake --cores $(CORES) --config scenarios='[smoke]'

teleop: $(STAMP)  ## what knowing the robots' tasks is worth, twenty minutes (results/teleop_fading)
	$(RUN) snakemake --cores $(CORES) --config scenarios='[teleop_fading]'

teleop-learning: $(STAMP)  ## what learning adds to that, half an hour (results/teleop_learning, teleop_learning_105)
	$(RUN) snakemake --cores $(CORES) --config scenarios='[teleop_learning, teleop_learning_105]'

readme: $(STAMP)  ## write the verdicts of results/paper into the README
	$(RUN) python src/hiersched/workflow/scripts/readme.py --results results/paper

docs: $(STAMP)  ## write the generated parts of the documents, and the JSON schema of scenarios
	$(RUN) python docs/generate.py

site: $(STAMP)  ## the documents as a site, links checked, the notebook run (results/site)
	"$(VENV)/bin/python" -m pip install --quiet $(PIP_ARGS) -c constraints.txt -e '.[dev,docs]'
	$(RUN) python -m sphinx -W --keep-going -q -b html -c docs -d results/.doctrees . results/site
	$(RUN) python docs/check_site.py results/site

gains: $(STAMP)  ## design the gains that the package ships anew
	$(RUN) python src/hiersched/workflow/scripts/ship_gains.py

test: $(STAMP)  ## the tests, in about three minutes
	$(RUN) python -m pytest -n $(CORES) --dist loadgroup

nightly: $(STAMP)  ## the tests that take longer: fuzzing, kills, tutorials, others' wrappers, whole studies, other Pythons
	"$(VENV)/bin/python" -m pip install --quiet $(PIP_ARGS) -c constraints.txt -e '.[dev,wrappers,docs,slurm,viewer]'
	$(RUN) python -m pytest -n $(CORES) --dist loadgroup -m nightly
	$(RUN) python -m pytest -n $(CORES) --dist loadgroup tests/env
	$(RUN) bash tests/pythons.sh all 3.12 3.13

mutants: $(STAMP)  ## 60 mutants and the tests that kill them, in an hour or two (results/mutants.tsv)
	"$(VENV)/bin/python" -m pip install --quiet $(PIP_ARGS) -c constraints.txt -e '.[dev,mutants]'
	$(RUN) python tests/mutants/run.py

lint: $(STAMP)  ## style, types, import directions, workflow format
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy
	$(RUN) lint-imports
	$(RUN) snakefmt --check workflow src/hiersched/workflow

format: $(STAMP)  ## let the formatters have their way
	$(RUN) ruff check --fix-only --quiet .
	$(RUN) ruff format .
	$(RUN) snakefmt workflow src/hiersched/workflow

oldest:  ## the kernels' tests on the oldest Numba that pyproject.toml allows (an environment of its own)
	test -x .venv-oldest/bin/python || "$(PYTHON)" -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install --quiet $(PIP_ARGS) "numba==$(OLDEST_NUMBA)" "numpy<2.2" -e '.[control]' mcap-protobuf-support pytest hypothesis
	.venv-oldest/bin/python -m pytest -q tests/core tests/simulator

pythons:  ## the tests that need no torch on Python 3.12 and 3.13, where they are (an environment each)
	$(RUN) bash tests/pythons.sh all 3.12 3.13

bench: $(STAMP)  ## speed of the slot loop, the environments, the log, the gain design and the learners
	$(RUN) python benchmarks/run.py

bench-short: $(STAMP)  ## the same way with less work, in half a minute: does it still run?
	$(RUN) python benchmarks/run.py --short

clean:  ## remove caches and build leftovers (results/ and the environment stay)
	rm -rf results/.kernels results/.doctrees results/.jupyter_cache build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

distclean: clean  ## remove the environments and the results too
	rm -rf "$(VENV)" .venv-oldest .venv-3.12 .venv-3.13 results .snakemake
