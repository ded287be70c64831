# Every target works from a fresh clone: what it needs is set up first, once.

# A module's tests on one worker, which shares what they make; the long ones, first by name, first.
PYTEST = .venv/bin/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder
DEMO_OUT ?= runs/demo
# Two workers and the processes that they start would compile everything each.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all check docs fuzz bench bench-long baseline clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# Two stamps, because running needs less than developing: the demo does not wait for linters.
.venv/.runtime-stamp: pyproject.toml scripts/setup.sh
	@bash scripts/setup.sh runtime

.venv/.dev-stamp: .venv/.runtime-stamp
	@bash scripts/setup.sh dev

# Recordings of experiments, once in our own layouts, where the published ones lie.
DATA := ../shared/data
STARRY_NIGHT := $(DATA)/landmarks/utias_starry_night_dataset3.mat
CHESS := $(DATA)/stanford_chess_grid
CONVERTED := $(if $(wildcard $(STARRY_NIGHT)),build/recordings/starry_night) \
  $(if $(wildcard $(CHESS)),build/recordings/chess_trinocular)

setup: .venv/.dev-stamp $(CONVERTED) ## make .venv with package and tools; convert what ../shared/data has

build/recordings/starry_night: | .venv/.runtime-stamp
	.venv/bin/python -m scripts.convert.starry_night $(STARRY_NIGHT) $@

build/recordings/chess_trinocular: | .venv/.runtime-stamp
	.venv/bin/python -m scripts.convert.light_field $(CHESS) $@

demo: .venv/.runtime-stamp ## render the lab, run the paper's drive through it, write runs/demo
	.venv/bin/fgslam demo --out $(DEMO_OUT)

test: setup ## the tests that take seconds
	$(PYTEST)

test-all: setup ## all tests, the slow ones too
	$(PYTEST) -m ""

check: setup ## linter, formatter and type checker; changes nothing
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/python -m scripts.check_words

docs: setup ## build the documentation into build/site; strict, without network
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict --quiet
	.venv/bin/python -m scripts.check_site build/site

FUZZ_CASES ?= 500

fuzz: setup ## damaged and odd inputs of each kind to what reads them (FUZZ_CASES=5000 for long)
	.venv/bin/python -m scripts.fuzz --cases $(FUZZ_CASES)

bench: setup ## measure speed as ratios, write bench.json
	.venv/bin/python -m benchmarks speed

bench-long: setup ## estimators over 2,500 frames beside batch, write bench_long.json (minutes, 2 GB)
	.venv/bin/python -m benchmarks long_drive

# `make baseline BASELINE=write BASELINES="lab_trials outliers"` writes them anew.
BASELINE ?= check
BASELINES ?= $(basename $(notdir $(wildcard experiments/baselines/*.json)))
BASELINE_ESTIMATORS ?= odometry,landmark_kalman,fixed_lag,isam2,batch

baseline: .venv/.runtime-stamp ## repeat the experiments that have a committed baseline, check them (minutes)
	@set -e; for name in $(BASELINES); do \
	  .venv/bin/fgslam compare experiments/$$name.yaml --trials 3 --seed 0 --jobs 2 \
	    --estimators $(BASELINE_ESTIMATORS) --out runs/baseline/$$name --overwrite; \
	  .venv/bin/python -m benchmarks.baseline $(BASELINE) runs/baseline/$$name experiments/baselines/$$name.json; \
	done

clean: ## remove the environment, caches and results
	rm -rf .venv runs bench.json bench_long.json build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
