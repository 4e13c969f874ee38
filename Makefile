# make demo   set up, run three jobs through the service on the built-in subject, print the table
# make up     serve API, worker and page on http://127.0.0.1:8000 until stopped
# make test   set up, run all tests
# make check  format, lint, types, import contracts
# make check-native  the kernels under address, undefined-behaviour and thread sanitizers
# make soak   a grid of a thousand small trainings while something is killed every few seconds; SOAK='--jobs 100 --postgresql'
#             SOAK='--grid ablation --subjects DIR --set preset=draft --kill-every 60' runs that grid and prints its table
# make paper-table ZJU=DIR  the paper's whole table, from ZJU-MoCap (my_377 ..) on disk
# make bench  the long measurements; results in docs/benchmarks
# make screenshots URL=http://127.0.0.1:8000   every page of a running service, into docs/screens
# make studies  ablation, calibration, exposure, losses, robustness, skips, superres: hours; JOBS=N at a time, SUBJECTS='DIR ...'

PYTHON ?= python3
BIN := .venv/bin
SETUP := .venv/.complete
JOBS ?= 1

.PHONY: setup demo up test check check-native soak bench screenshots clean studies paper-table
.DEFAULT_GOAL := help

help:
	@sed -n 's/^# //p' Makefile

setup: $(SETUP)

# Depends on what decides the installation, so a change of kernels or dependencies sets up again.
$(SETUP): pyproject.toml setup.py $(wildcard core/native/*)
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and f"python: expected 3.11 or newer, got {v[0]}.{v[1]} (set PYTHON=...)")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

demo: $(SETUP)
	$(BIN)/python -m services.demo

up: $(SETUP)
	$(BIN)/python -m services.up

test: $(SETUP)
	$(BIN)/python -m pytest

check: $(SETUP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check-native: $(SETUP)
	$(BIN)/python -m tests.native.sanitize

soak: $(SETUP)
	$(BIN)/python -m tests.system.soak $(SOAK)

paper-table: $(SETUP)
	@test -n "$(ZJU)" || { echo 'ZJU: expected the folder with my_377 .. my_394, got nothing (make paper-table ZJU=DIR)' >&2; exit 2; }
	$(BIN)/python -m services.paper --zju "$(ZJU)"

bench: $(SETUP)
	$(BIN)/rsavatar bench render --json docs/benchmarks/render.json
	$(BIN)/rsavatar bench growth --json docs/benchmarks/growth.json
	$(BIN)/rsavatar bench train --json docs/benchmarks/train.json
	$(BIN)/rsavatar bench stability --json docs/benchmarks/stability.json
	$(BIN)/rsavatar bench builder --json docs/benchmarks/builder.json
	$(BIN)/python -m services.bench --json docs/benchmarks/service.json

studies: $(SETUP)
	for name in ablation calibration losses robustness skips superres; do \
		$(BIN)/rsavatar bench $$name --jobs $(JOBS) $(if $(SUBJECTS),--subjects $(SUBJECTS)) --json docs/benchmarks/$$name.json || exit 1; \
	done
	$(BIN)/rsavatar bench restore --jobs $(JOBS) $(if $(SUBJECTS),--subjects $(SUBJECTS)) --json docs/benchmarks/restoration.json
	$(BIN)/rsavatar bench exposure --jobs $(JOBS) --json docs/benchmarks/exposure.json

URL ?= http://127.0.0.1:8000
screenshots: $(SETUP)
	$(BIN)/python -m docs.screenshots $(URL)

clean:
	rm -rf .venv build core/*.egg-info core/rsavatar/render/_kernels_*.so
