# Everything runs in .venv, which the first target that needs it makes from pyproject.toml.
PYTHON ?= python3.11
# For Blender 5.3, whose module bpy needs it
PYTHON_5_3 ?= python3.13
BIN := .venv/bin
# tests/conftest.py says how many processes. `worksteal` gives each of them neighboring tests, so that few fixtures are
# made twice.
PARALLEL := -n auto --dist worksteal
# Bytecode is kept also where the environment forbids it: each process would compile all modules, and its tests'
# assertions, anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo demo-footage test test-all test-5.3 kernels test-fast test-tools test-gui lint lint-web fuzz extension extension-bare extension-complete repository clean

demo: .venv/ready
	$(BIN)/python -m stga_addon demo --out out/demo

# The demo, and then a second avatar from its images and cameras alone
demo-footage: .venv/ready
	$(BIN)/python -m stga_addon demo --out out/demo --footage

# What a commit needs
test: .venv/ready
	$(MAKE) --jobs 2 --output-sync lint kernels
	$(BIN)/python -m pytest $(PARALLEL) -m "not nightly"

# Clusters, kills, long runs, other versions of Blender, comparisons with Cycles as well
test-all: .venv/ready
	$(MAKE) --jobs 2 --output-sync lint kernels
	$(BIN)/python -m pytest $(PARALLEL)
	$(MAKE) test-5.3

# Blender's side in Blender 5.3
test-5.3: .venv-5.3/ready
	.venv-5.3/bin/python -m pytest $(PARALLEL) tests/blender -m "not nightly"

# What the tests would each compile
kernels: .venv/ready
	$(BIN)/python tests/kernels.py

test-fast: .venv/ready
	$(BIN)/python -m pytest $(PARALLEL) -m "not slow and not nightly"

# What `make test` skips on a machine without a graphics driver, a browser or Node.js
test-tools: .venv/ready
	$(BIN)/python -m pytest $(PARALLEL) -m "needs and not nightly"

# STGA_BLENDER: the command that starts a Blender with a window (docs/blender.md)
test-gui: .venv/ready
	$(BIN)/python -m pytest tests/gui -s

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Node.js: format and types of the web page's player
PLAYER := stga_addon/export/web/player
lint-web:
	npx --yes prettier@3.6.2 --check '$(PLAYER)/*.js' '!$(PLAYER)/constants.js' '$(PLAYER)/*.ts' '$(PLAYER)/jsconfig.json'
	npx --yes -p typescript@5.9.3 tsc --noEmit --project $(PLAYER)/jsconfig.json

fuzz: .venv/ready
	STGA_FUZZ_SECONDS=$${STGA_FUZZ_SECONDS:-300} STGA_FUZZ_CASES=$${STGA_FUZZ_CASES:-20000} \
		$(BIN)/python -m pytest $(PARALLEL) tests/fuzz tests/numerics/test_generated.py

extension: .venv/ready
	$(BIN)/python -m stga_addon.development.package --out dist

# As extension, without others' data that are not in the public domain
extension-bare: .venv/ready
	$(BIN)/python -m stga_addon.development.package --edition bare --out dist

# BLENDER: the command that starts a Blender, for the Python of that Blender alone; ALL=1: for every platform;
# CUDA=1: with PyTorch's CUDA build where its CPU build cannot be had
extension-complete: .venv/ready
	$(BIN)/python -m stga_addon.development.package --edition complete --out dist \
		$(if $(BLENDER),--blender '$(BLENDER)') $(if $(ALL),--all) $(if $(CUDA),--allow-cuda)

# The zips of dist as a repository for Blender, in dist/repository
repository: .venv/ready
	$(BIN)/python -m stga_addon.development.repository dist --out dist/repository --blender '$(or $(BLENDER),blender)'

.venv-5.3/ready: PYTHON = $(PYTHON_5_3)
.venv/ready .venv-5.3/ready: pyproject.toml
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --editable '.[dev]'
	# Without dependencies: it lists numpy 2, and runs with numpy 1.26 too.
	$(@D)/bin/pip install --quiet --no-deps opencv-python-headless==4.14.0.94
	touch $@

clean:
	rm -rf .venv .venv-5.3 build dist out wheels *.egg-info
