# Two commands for a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2

.PHONY: setup demo test test-float32 test-x64 lint bench lock

setup: $(VENV)/ready

$(VENV)/ready: requirements.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	test -x $(BIN)/uv || $(BIN)/python -m pip install --quiet uv
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip sync --quiet --require-hashes requirements.lock
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

# The built-in bust, in soft skin: out/bust.png and out/bust.exr.
demo: setup
	mkdir -p out
	$(BIN)/splatjax render --output out/bust.exr

# Everything CI checks: style, types, the flow of imports, and the suite in both precisions.
test: lint test-float32 test-x64

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/ty check
	$(BIN)/lint-imports

test-float32: setup
	$(BIN)/python -m pytest -n $(WORKERS)

test-x64: setup
	JAX_ENABLE_X64=1 $(BIN)/python -m pytest -n $(WORKERS)

bench: setup
	$(BIN)/python -m benchmarks

# Written anew when dependencies change; hashes, no addresses.
lock: setup
	$(BIN)/uv pip compile pyproject.toml --group dev --python-version 3.11 --universal --generate-hashes \
	    --no-emit-index-url --no-emit-find-links --no-annotate --no-header --output-file requirements.lock
