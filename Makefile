# Two commands for a fresh machine: `make demo` and `make test`. Others: docs, notebooks, gallery, bench, release-check.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2
# A suite's time is XLA's. Files stay whole, so that a worker meets again what it has compiled, and in the order of
# tests/conftest.py: the longest first. The float32 run is compiled as users have it; the others with the least
# optimization, which takes a third of the time.
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
LEAST_OPTIMIZATION := --xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false \
    --xla_cpu_parallel_codegen_split_count=1
# Every worker of every run imports the same modules, with their shapes checked: whatever the shell sets, bytecode is kept.
unexport PYTHONDONTWRITEBYTECODE
# Compilers allocate and free much: memory that is kept need not be cleared again, and no error of a test needs the line of
# Python that each instruction came from. Together a tenth of the time. Demo and benchmarks run as users have it.
TESTS := test-float32 test-x64 test-once test-long random-scenes coverage
$(TESTS): export MALLOC_TRIM_THRESHOLD_ := 4000000000
$(TESTS): export MALLOC_TOP_PAD_ := 67108864
$(TESTS): export MALLOC_MMAP_THRESHOLD_ := 1000000000
$(TESTS): export JAX_TRACEBACK_IN_LOCATIONS_LIMIT := 0

.PHONY: setup demo test test-float32 test-x64 test-once test-long random-scenes fuzz mutants coverage lint bench lock sbom docs \
    always figures notebooks gallery release-check release-check-lowest

setup: $(VENV)/ready

$(VENV)/ready: requirements.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	test -x $(BIN)/uv || $(BIN)/python -m pip install --quiet uv
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip sync --quiet --require-hashes requirements.lock
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

# The built-in bust, seven centimeters of skin: out/bust.png, and out/plain.png without light below the surface.
demo: setup
	mkdir -p out
	$(BIN)/splatjax render --scale 0.2 --output out/bust.exr
	$(BIN)/splatjax render --scale 0.2 --no-scattering --output out/plain.exr

# Everything CI checks: style, types, the flow of imports, and the suite in both precisions.
test: lint test-float32 test-x64 test-once

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/ty check
	$(BIN)/lint-imports
	$(BIN)/typos

test-float32: setup
	$(PYTEST) -m "not once and not unoptimized and not long"

# Shapes are checked in the other runs.
test-x64: setup
	JAX_ENABLE_X64=1 XLA_FLAGS="$(LEAST_OPTIMIZATION) $$XLA_FLAGS" $(PYTEST) --jaxtyping-packages=none,beartype.beartype \
	    -m "not long"

# Long tests whose answer float64 does not change, and those of files and searches, which no optimization changes.
test-once: setup
	XLA_FLAGS="$(LEAST_OPTIMIZATION) $$XLA_FLAGS" $(PYTEST) -m "(once or unoptimized) and not long"

# What `make test` has no time for, in both precisions.
test-long: setup
	XLA_FLAGS="$(LEAST_OPTIMIZATION) $$XLA_FLAGS" $(BIN)/python -m pytest -n $(WORKERS) --dist load -m long
	JAX_ENABLE_X64=1 XLA_FLAGS="$(LEAST_OPTIMIZATION) $$XLA_FLAGS" \
	    $(BIN)/python -m pytest -n $(WORKERS) --dist load -m long

# Ten thousand scenes and losses, in both precisions: no gradient of a finite loss may be infinite or no number. And five hundred
# bodies of every kind: the fast rasterizer is the plain one.
random-scenes: setup
	SPLATJAX_RANDOM_SCENES=10000 XLA_FLAGS="$(LEAST_OPTIMIZATION) $$XLA_FLAGS" \
	    $(BIN)/python -m pytest -n $(WORKERS) --dist load -q tests/gradients/test_random_scenes.py tests/splatting/test_rasterizers.py

# Twenty thousand spoiled files for every reader; those that fail are added to tests/io/corpus. `tools/fuzz.py` has files that
# grow along new lines of code, by atheris.
fuzz: setup
	SPLATJAX_FUZZ=20000 $(BIN)/python -m pytest -n $(WORKERS) --dist load -q tests/io/test_corpus.py -k spoiled

# Faults planted in one module, each against some tests: make mutants MODULE=splatjax/shading/_specular.py TESTS=tests/shading
# Best in a worktree of its own, since the module changes while it runs. Of cosmic-ray (MIT) only this target has need.
mutants: setup
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip install --quiet cosmic-ray
	mkdir -p out
	printf '[cosmic-ray]\nmodule-path = "$(MODULE)"\ntimeout = 600.0\nexcluded-modules = []\n' > out/mutants.toml
	printf 'test-command = "$(BIN)/python -m pytest -q -x $(TESTS)"\n' >> out/mutants.toml
	printf '[cosmic-ray.distributor]\nname = "local"\n' >> out/mutants.toml
	$(BIN)/cosmic-ray init --force out/mutants.toml out/mutants.sqlite
	$(BIN)/cosmic-ray exec out/mutants.toml out/mutants.sqlite
	$(BIN)/cr-report --show-diff out/mutants.sqlite | grep -A 30 SURVIVED || echo every fault was noticed

# Which statements and branches of the package the float32 suite executes: a table in out/coverage.txt. Tracing makes tests
# take 40% more processor time, so a weekly workflow runs this, and `make test` does not.
coverage: setup
	rm -f out/.coverage*
	XLA_FLAGS="$(LEAST_OPTIMIZATION) $$XLA_FLAGS" $(BIN)/coverage run -m pytest -q -n $(WORKERS) --dist loadfile -m "not long"
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report | tee out/coverage.txt

bench: setup
	$(BIN)/python -m benchmarks
	$(BIN)/python -m benchmarks.diffusion_error
	$(BIN)/python -m benchmarks.shimmer

# The site, in out/site: pages, the API from its docstrings, and the notebooks with what they print and draw. Executed notebooks
# are kept, and run again when the content of their program, of the code or of the lock has changed, which takes some minutes;
# `make -j2 docs` runs two at once. Most of that is XLA's, so they are compiled as in the tests: those that run longer than they
# compile as users have it.
NOTEBOOKS := $(wildcard notebooks/*.py)
SOURCES := $(sort $(shell find splatjax profiles -name '*.py' -o -name '*.toml')) requirements.lock
KEYS := $(NOTEBOOKS:notebooks/%.py=out/notebooks/%.key)

docs: $(VENV)/docs $(NOTEBOOKS:notebooks/%.py=out/notebooks/%.ipynb)
	@echo 'building pages into out/site, half a minute'
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo 'checking links'
	@$(BIN)/python tools/check_site.py out/site
	@echo out/site/index.html

# A digest of what a notebook depends on; the file changes only if that does.
$(KEYS): out/notebooks/%.key: notebooks/%.py always
	@mkdir -p out/notebooks
	@cat $< $(SOURCES) | sha256sum > $@.new
	@if cmp -s $@.new $@; then rm $@.new; else mv $@.new $@; fi

always:

out/notebooks/%.ipynb: COMPILED := $(LEAST_OPTIMIZATION)
out/notebooks/shape_from_shading.ipynb out/notebooks/which_profile.ipynb: COMPILED :=

out/notebooks/%.ipynb: out/notebooks/%.key | $(VENV)/docs
	@echo 'running notebooks/$*.py, up to two minutes'
	@mkdir -p out/notebooks/running
	@$(BIN)/jupytext --quiet --to ipynb --output out/notebooks/running/$*.ipynb notebooks/$*.py
	@cd out/notebooks/running && XLA_FLAGS="$(COMPILED)$${XLA_FLAGS:+ $$XLA_FLAGS}" $(abspath $(BIN))/jupyter-execute --inplace --timeout 3600 $*.ipynb
	@mv out/notebooks/running/$*.ipynb $@

# The paper's figures, into out/figures.
figures: $(patsubst notebooks/%.py,out/notebooks/%.ipynb,$(wildcard notebooks/figure_*.py))
	mkdir -p out/figures
	$(BIN)/python tools/docs_pages.py out/figures $^

$(VENV)/docs: requirements-docs.lock $(VENV)/ready
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip install --quiet --require-hashes --requirements requirements-docs.lock
	touch $@

# JupyterLab, with copies of the notebooks in out/lab: what is changed there is yours, until the notebook itself changes.
notebooks: $(VENV)/notebooks $(NOTEBOOKS:notebooks/%.py=out/lab/%.ipynb)
	$(BIN)/jupyter-lab out/lab

out/lab/%.ipynb: notebooks/%.py | $(VENV)/notebooks
	mkdir -p out/lab
	$(BIN)/jupytext --quiet --to ipynb --output $@ $<

$(VENV)/notebooks: requirements-notebooks.lock $(VENV)/ready
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uv pip install --quiet --require-hashes --requirements requirements-notebooks.lock
	touch $@

# The pictures of docs/gallery.md, into out/gallery; HEAD=head.ply names the scan that three of them show.
gallery: setup
	$(BIN)/python tools/make_gallery.py $(if $(HEAD),--head $(HEAD))

# Wheel and sdist, into dist; and whether they work where there is no checkout, with the newest or the lowest versions of what
# they need.
release-check: setup
	rm -rf dist
	$(BIN)/hatchling build --target sdist --target wheel
	$(BIN)/python tools/release_check.py $(LOWEST)

release-check-lowest: LOWEST := --lowest
release-check-lowest: release-check

# What the locked environment consists of, by CycloneDX: out/sbom.json. Of cyclonedx-bom (Apache-2.0) only this target has need.
sbom: setup
	mkdir -p out
	VIRTUAL_ENV=$(abspath $(VENV)) $(BIN)/uvx --quiet --from cyclonedx-bom cyclonedx-py requirements --output-reproducible \
	    --output-file out/sbom.json requirements.lock

# Rewritten when dependencies change; hashes, no addresses. What docs and notebooks need besides is in locks of its own, so that
# setting up stays quick.
COMPILE := $(BIN)/uv pip compile --python-version 3.11 --universal --generate-hashes --no-emit-index-url --no-emit-find-links \
    --no-annotate --no-header

lock: setup
	$(COMPILE) pyproject.toml --group dev --output-file requirements.lock
	$(COMPILE) --group docs --constraints requirements.lock --output-file requirements-docs.lock
	$(COMPILE) --group lab --constraints requirements.lock --output-file requirements-notebooks.lock
