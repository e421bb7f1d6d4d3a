# Two commands for a bare machine with Python >= 3.11 and pip:  make demo   and   make test
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt

.PHONY: demo test test-all test-nightly checks lint kernels metrics docs notebooks wheel kernels-wheel smoke image
.PHONY: check-tag install-from clients compat clean

demo: $(VENV)/.core  ## run three robots that explore an office, build maps and merge them; writes a folder under runs/
	$(BIN)/vslam run --world office --robots 3 --policy next_best_view --action-type continuous --seed 0

PYTEST := -m pytest --numprocesses auto --maxprocesses 4 --dist worksteal

test: checks  ## linters, and all tests that are not marked slow
	$(BIN)/python $(PYTEST) -m "not slow"

test-all: checks  ## linters and all tests that are not marked nightly
	$(BIN)/python $(PYTEST) -m "not nightly"

test-nightly: $(VENV)/.dev  ## the tests that compile kernels from scratch or soak for minutes
	$(BIN)/python $(PYTEST) -m nightly

checks: $(VENV)/.dev  # linters, and meanwhile the compilation of the kernels
	@$(MAKE) --no-print-directory --jobs 2 kernels lint

lint: $(VENV)/.dev  ## style, types, the direction of imports, and prose
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m studies.prose

kernels: $(VENV)/.dev  ## compile all kernels
	$(BIN)/vslam warm-up --all --report

metrics: $(VENV)/.core  ## metrics of the code: sizes, folders, path of a measurement, private accesses, import cycles
	$(BIN)/python -m studies.code_metrics

docs: $(VENV)/.docs  ## build the site in site/; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

notebooks: $(VENV)/.docs  ## run the notebooks in Jupyter and keep their output; takes minutes
	$(PIP) --editable ".[docs,jax]"
	$(BIN)/python -m studies.notebooks

wheel: $(VENV)/bin/python  ## build the source distribution in dist/, and from it the wheel
	$(PIP) build
	$(BIN)/python -m build --outdir dist

kernels-wheel: $(VENV)/.core  ## build a wheel of kernels compiled for x86-64-v3 and v4 in dist/; takes minutes
	$(BIN)/python -m slam_backend.core.compilation.wheel dist slam_backend vslam_env

VERSION := $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
SMOKE := $(VENV)-smoke/bin/python

smoke:  ## install the wheels of dist/ into an environment of their own, and try them there without the checkout
	rm -rf $(VENV)-smoke
	$(PYTHON) -m venv $(VENV)-smoke
	$(SMOKE) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --find-links dist vslam-env==$(VERSION) vslam-env-kernels==$(VERSION) pytest hypothesis
	$(SMOKE) tests/packaging/smoke.py --tests

image:  ## build the image of the command line with Docker
	docker build --tag vslam-env:$(VERSION) .

check-tag:  ## refuse a TAG of a release that is not the version of the package and of the changelog
	test "$(TAG)" = "v$(VERSION)"
	grep "^## \[$(VERSION)\] - 20" CHANGELOG.md

install-from:  ## let pages install from VSLAM_WHEEL: a folder or page of wheels, a wheel, or the published name
	grep -rl --include=*.md --include=*.py --include=*.ipynb "VSLAM_WHEEL=" README.md docs | xargs sed -i 's|VSLAM_WHEEL=[^ "\\]*|VSLAM_WHEEL=$(VSLAM_WHEEL)|'

CLIENTS := torchrl rllib agilerl tianshou benchmarl

clients: $(CLIENTS:%=client-%)  ## run the program of each learner as written, in its own environment; needs gigabytes

client-%: docs/how-to/learners.md docs/how-to/learners/%.txt
	$(PYTHON) -m venv $(VENV)-clients/$*
	$(VENV)-clients/$*/bin/python -m pip install --quiet --disable-pip-version-check --editable . --requirement docs/how-to/learners/$*.txt
	$(VENV)-clients/$*/bin/python tests/docs/run_page.py $< $*

compat: compat-opencv compat-pettingzoo  ## all tests with an older OpenCV, and with the versions pinned by RLlib and AgileRL

compat-opencv: OTHER := opencv-python-headless==4.14.0.94
compat-pettingzoo: OTHER := gymnasium==1.2.2 pettingzoo==1.26.1

compat-%: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)-compat/$*
	$(VENV)-compat/$*/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	$(VENV)-compat/$*/bin/python -m pip install --quiet --disable-pip-version-check $(OTHER)
	$(VENV)-compat/$*/bin/python $(PYTEST)

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit("vslam_env needs Python >= 3.11, but $(PYTHON) is " + sys.version.split()[0] + ": use make PYTHON=python3.11" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.core: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) --editable .
	touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) --editable ".[dev]"
	touch $@ $(VENV)/.core

$(VENV)/.docs: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) --editable ".[docs]"
	touch $@ $(VENV)/.core

clean:
	rm -rf $(VENV) $(VENV)-clients $(VENV)-compat build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -prune -exec rm -rf {} +
