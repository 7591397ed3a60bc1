PYTHON ?= python3
BIN := .venv/bin
PYTEST := $(BIN)/python -m pytest
UNOPTIMISED := XLA_FLAGS=--xla_backend_optimization_level=0

# Whole files to each worker, which a module's fixtures and programs ask for.
SPREAD := -n 2 --dist loadfile

# Else each program that a test starts compiles JAX and all else anew: 5 s of CPU time each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: sweep test test-slow test-nightly lint types docs clean .venv

# The main job: search the paper's case 1.2 for better gains.
sweep: .venv/.installed
	$(BIN)/mjx-climb sweep configs/case_1_2.yaml --stiffness 1e2:1e6:12 --damping 1e0:1e5:12 --out results/case_1_2

# COVER=--cov prints which lines the tests reach, for a few per cent of their time.
# Its programs are compiled more often than walked: without LLVM's optimisations, as those of the next.
# (xla_cpu_use_fusion_emitters=false compiles sooner, but wrongly: tests/gait/test_climblab_choices.py shows it.)
test: .venv/.installed-test
	$(UNOPTIMISED) $(PYTEST) $(SPREAD) -m "not slow and not timing and not nightly" $(COVER)

# Those that compare speeds run alone, and compiled as users' programs are.
test-slow: .venv/.installed-test
	$(UNOPTIMISED) $(PYTEST) $(SPREAD) -m "slow and not timing and not nightly"
	$(PYTEST) -m "timing and not nightly" $$(grep -rl mark.timing tests)

# Whole searches and notebooks, every robot, shape and law from start to end: some three hours.
test-nightly: .venv/.installed-test
	$(PYTEST) $(SPREAD) -m "nightly and not timing"
	$(PYTEST) -m "nightly and timing"

lint: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo

# NO_MKDOCS_2_WARNING: the theme's notice about a release that pyproject.toml keeps out.
types: .venv/.installed-dev
	$(BIN)/mypy

docs: .venv/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "build/docs/index.html"

.venv: .venv/.installed-test

# One stamp for each set of packages: nothing is installed again until pyproject.toml changes.
# EXTRAS=[dev,docs] installs those in the first place.
.venv/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "mjx-climb needs Python 3.11 or newer as $(PYTHON); choose another with make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".$(EXTRAS)"
	@touch $@

.venv/.installed-%: .venv/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[$*]"
	@touch $@

clean:
	rm -rf .venv build dist results out .pytest_cache .coverage .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
