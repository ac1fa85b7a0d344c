# The two commands that matter: `make demo` and `make test`. `make help` lists the rest.
.DEFAULT_GOAL := help
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
DOCS_VENV := .venv-docs
OUT ?= runs/demo
# Python compiles each file once, not in every process: tests start hundreds, each of them a second sooner.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help
help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1|/' | awk -F'|' '{printf "  make %-10s %s\n", $$1, $$2}'

.PHONY: demo
demo: $(VENV)/.runtime ## Set up, fly the paper's mission and say where the report is
	$(BIN)/uav-twin run level_turns --out $(OUT) --replace

.PHONY: test
test: $(VENV)/.dev ## Set up and run all tests (with UAV_TWIN_LONG_TESTS=1 those that take minutes, too)
	$(BIN)/python -m pytest -n 3 --dist loadgroup --no-loadscope-reorder

.PHONY: test-quick
test-quick: $(VENV)/.dev ## Set up and run the three fifths of the tests that take a fraction of a second each
	$(BIN)/python -m pytest -n 2 --dist loadgroup --no-loadscope-reorder --quick

.PHONY: setup
setup: $(VENV)/.dev ## Make .venv with everything that development needs

.PHONY: lint
lint: $(VENV)/.dev ## Check style, docstrings, types and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

BENCH ?=

.PHONY: bench
bench: $(VENV)/.dev ## Measure speed, memory and errors beside other programs (BENCH="NAME --json FILE ...": what and how)
	$(BIN)/python -m benchmarks $(BENCH)

PICTURES ?=

.PHONY: pictures
pictures: $(VENV)/.dev ## Draw the pictures of README and docs, and say where pages state other numbers (PICTURES="NAME ...": these)
	$(BIN)/python -m benchmarks.pictures $(PICTURES)

BLIND ?= runs/blind

.PHONY: blind
blind: $(VENV)/.dev ## Hide effects in campaigns, name them, and score the names (two hours on two cores)
	$(BIN)/python -m benchmarks.blind generate --out $(BLIND) --count-per-effect 8 --nulls 300 --pairs 40 --outside 2 --traps 3 --seed 3
	$(BIN)/python -m benchmarks.blind_naming $(BLIND)
	$(BIN)/python -m benchmarks.blind score --out $(BLIND)

.PHONY: fmu
fmu: $(VENV)/.runtime ## Build the wing as an FMU into runs/wing.fmu
	@mkdir -p runs
	$(BIN)/uav-twin fmu build --out runs/wing.fmu --replace

NOTEBOOKS ?= force

.PHONY: docs
docs: $(DOCS_VENV)/.docs ## Build the site of the documentation into build/docs; a warning is an error (NOTEBOOKS=off: without running them)
	PYTHONPATH=$(CURDIR) OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(DOCS_VENV)/bin/python -m sphinx -j 2 -q -W --keep-going -D nb_execution_mode=$(NOTEBOOKS) \
	  -c docs/site -d build/doctrees docs build/docs
	@echo "The site is build/docs/index.html."

.PHONY: lock
lock: $(VENV)/.dev ## Renew the lock files from pyproject.toml and docs/site/requirements.in
	$(BIN)/pip-compile -q --upgrade --extra build --extra fast -o requirements.lock pyproject.toml
	$(BIN)/pip-compile -q --extra build --extra dev -c requirements.lock -o requirements-dev.lock pyproject.toml
	$(BIN)/pip-compile -q -c requirements.lock -o requirements-docs.lock docs/site/requirements.in

.PHONY: clean
clean: ## Remove .venv, .venv-docs, build, runs and caches of this folder
	rm -rf $(VENV) $(DOCS_VENV) runs build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or later is needed, found " + sys.version.split()[0] + "; call make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)

# Packages are compiled by all cores at once, where pip takes one; their own tests are left out, and large packages
# that nearly no process imports.
NOT_COMPILED := tests|debugpy|fontTools|huggingface_hub|mypy|mypyc|narwhals|networkx|pgmpy|pip|sklearn|sqlalchemy|statsmodels
install = $(1)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --require-hashes -r $(2)
install_project = $(BIN)/python -m pip install -qq --disable-pip-version-check --no-build-isolation --no-deps --editable .
compile = @$(1)/bin/python -m compileall -qq -j 0 -x '/($(NOT_COMPILED))/' $$($(1)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') || true

$(VENV)/.runtime: requirements.lock pyproject.toml | $(VENV)/bin/python
	@echo "Installing the packages of requirements.lock into $(VENV): about a minute the first time."
	$(call install,$(VENV),requirements.lock)
	$(install_project)
	$(call compile,$(VENV))
	@touch $@

# The packages of requirements.lock are among these.
$(VENV)/.dev: requirements-dev.lock requirements.lock pyproject.toml | $(VENV)/bin/python
	@echo "Installing the packages of requirements-dev.lock into $(VENV): about a minute the first time."
	$(call install,$(VENV),requirements-dev.lock)
	$(install_project)
	$(call compile,$(VENV))
	@touch $(VENV)/.runtime $@

# The site reads docstrings and runs notebooks, so its packages see those of development behind their own.
$(DOCS_VENV)/.docs: requirements-docs.lock $(VENV)/.dev
	$(BIN)/python -m venv $(DOCS_VENV)
	$(call install,$(DOCS_VENV),requirements-docs.lock)
	$(call compile,$(DOCS_VENV))
	@$(BIN)/python -c 'import sysconfig; print("import site; site.addsitedir(%r)" % sysconfig.get_path("purelib"))' \
	  > "$$($(DOCS_VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/runtime.pth"
	@touch $@
