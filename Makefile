# Everything from Python 3.11 or newer and make: the first target that needs it makes .venv and installs pbng into it.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: demo test lint types format bench clean

demo: $(READY)  ## Twist a block and hang up a little dragon: films, pictures and tables in runs/demo
	$(BIN)/pbng demo --out runs/demo

test: $(READY)
	$(BIN)/python -m pytest

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(READY)
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(READY)
	$(BIN)/pbng bench sweep
	$(BIN)/pbng bench convergence
	$(BIN)/pbng bench accuracy --out runs/bench
	$(BIN)/pbng bench cycles
	$(BIN)/pbng bench poses
	$(BIN)/pbng bench frames --out runs/bench

clean:
	rm -rf .venv runs build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
	find src tests examples benchmarks -name __pycache__ -prune -exec rm -rf {} +

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "pbng needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@
