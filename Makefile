# The verbs of this repository; `make` alone lists them.
PYTHON ?= python3
BIN := .venv/bin
LOCKS := requirements.txt requirements-dev.txt
PROJECTS := pyproject.toml clients/python/pyproject.toml

.PHONY: help bench setup system-packages demo check test test-slow test-drivers chromium chaos fuzz service-figures image-test lock clean
.DELETE_ON_ERROR:

help:
	@echo "make setup       what octobake needs: Debian packages that are missing, Python packages in .venv, .venv/bin/octobake"
	@echo "make demo        setup; then serve, upload, bake and verify a Cornell box: pictures and figures in out/demo"
	@echo "make test        setup; then every test but the slow ones (ARGS=... goes to pytest)"
	@echo "make test-slow   setup; then the tests that take minutes"
	@echo "make chromium    headless Chromium in build/, where tests find a second Vulkan driver and a WebGL2 (Debian; nothing is installed)"
	@echo "make test-drivers   setup, chromium; then the GLSL module on lavapipe, on SwiftShader and on WebGL2"
	@echo "make chaos       setup; then 1,000 random kills of a service and its worker, about an hour (ARGS=\"--kills N --seed S\")"
	@echo "make fuzz        setup; then coverage-guided fuzzing of the scene reader, five minutes (ARGS=\"--seconds N --seed S\"); Linux, x86-64"
	@echo "make bench       setup; then every \`octobake bench\` on scenes of our own, five minutes on a quiet machine; out/bench has the tables and their history"
	@echo "make service-figures   setup; then what the service holds under load, two minutes on a quiet machine (ARGS=all: every goal, about an hour)"
	@echo "make image-test  build docker/Dockerfile with buildah (root, Debian), start it, bake and verify through it"
	@echo "make check       setup; then lint, format, types, import layers, shaders for both targets"
	@echo "make lock        choose package versions anew, and write them with their hashes to $(LOCKS)"
	@echo "make clean       remove .venv and everything generated"

setup: $(BIN)/.installed

system-packages:
	@PYTHON=$(PYTHON) .ci/system-packages

# Hashes for every package, wheels only: nothing is fetched that is not pinned, build tools included. The stamp makes a second setup quick.
# Bytecode is left to the first import: of all that is installed only a part is ever imported, and compiling all of it takes half the time.
$(BIN)/.installed: $(LOCKS) $(PROJECTS) | system-packages
	@$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 11) or sys.exit(f"setup: Python 3.11 or newer is needed and $(PYTHON) is {v[0]}.{v[1]}; name another with: make setup PYTHON=...")'
	@echo "setup: Python packages into .venv"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --only-binary :all: --require-hashes $(LOCKS:%=-r %)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-index --no-deps --no-build-isolation -e . -e clients/python
	@touch $@

demo: setup
	$(BIN)/octobake demo -o out/demo

test: setup
	$(BIN)/python -m pytest -m "not slow" $(ARGS)

test-slow: setup
	$(BIN)/python -m pytest -m slow $(ARGS)

test-drivers: setup chromium
	$(BIN)/python -m pytest tests/conformance tests/unit/test_shaders.py tests/unit/test_vulkan.py $(ARGS)

chromium: build/chromium

build/chromium:
	@.ci/chromium

chaos: setup
	$(BIN)/python -m tests.service.chaos $(ARGS)

fuzz: setup
	nice -n 19 $(BIN)/python -m tests.faults.fuzz $(ARGS)

bench: setup
	$(BIN)/octobake bench throughput -o out/bench
	$(BIN)/octobake bench scale -o out/bench --triangles-sizes 1000,10000,100000
	$(BIN)/octobake bench service -o out/bench --bake-seconds 10
	$(BIN)/octobake bench convergence -o out/bench --samples 16,64 --runs 1 --reference-samples 512
	$(BIN)/octobake bench targets -o out/bench --targets 0.05,0.02
	$(BIN)/octobake bench adaptive -o out/bench --runs 1
	$(BIN)/octobake bench leaving-out -o out/bench --runs 1
	$(BIN)/octobake bench integrators -o out/bench --runs 1

service-figures: setup
	$(BIN)/python -m tests.service.figures $(ARGS)

image-test:
	docker/image-test

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy bake_core service clients tests
	$(BIN)/lint-imports
	$(BIN)/python tests/compile_shaders.py

UV_COMPILE := $(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes --no-header --no-emit-index-url
lock: setup
	$(UV_COMPILE) $(PROJECTS) -o requirements.txt
	$(UV_COMPILE) --group dev -c requirements.txt -o requirements-dev.txt

clean:
	rm -rf .venv out build .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
