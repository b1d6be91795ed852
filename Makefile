# `make demo` and `make test` work on a bare machine with Python 3.11 or newer: the environment is made when missing.
PYTHON ?= python3
TEST_WORKERS ?= 2
BIN := .venv/bin
READY := .venv/.ready

.PHONY: demo test test-long lint types bench clean

demo: $(READY)
	$(BIN)/gyromodel demo

test: $(READY)
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/pytest -n $(TEST_WORKERS) --dist worksteal

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Studies of the engine, notebooks and README's examples: each test takes some ten seconds or more.
test-long: $(READY)
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/pytest -n $(TEST_WORKERS) --dist worksteal -m long

types: $(READY)
	$(BIN)/pyright

bench: $(READY)
	for study in benchmarks/[!_]*.py; do $(BIN)/python -m benchmarks.$$(basename $$study .py) || exit 1; done

clean:
	rm -rf .venv .cache build dist gyromodel-demo

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "gyromodel needs Python 3.11 or newer, and '$(PYTHON)' is not: name one, e.g. make PYTHON=python3.12" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@
