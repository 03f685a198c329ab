# Needs: Debian or Ubuntu, make, apt, Python >= 3.9 with venv. (On other systems, install an LLVM
# library by hand: mitsuba_ext/startup/llvm.py says which ones work.)
#
#   make demo    compares two of our integrators with `path` on three of our scenes, in two to four
#                minutes
#   make test    runs the default tests, on all cores
#   make test-slow  runs the long statistical tests, and other slow tests
#   make bench   runs the benchmarks on our scenes, and on ../shared/scenes if it exists; writes a
#                report, and the table and the plot of docs/results/benchmark.md
#   make docs    builds the documentation site, which needs no network, in out/docs; the results of
#                tutorials are kept in out/docs_work until the code of the tutorials changes
#   make lint    checks the code's style
#   make clean   removes everything that was built, `.venv` included, but not `out/`
#
# The first of these commands sets everything up in `.venv`; later ones start at once.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

DEMO_OUT := out/demo
DEMO := $(BIN)/mitsuba-ext compare scenes/door_ajar.xml scenes/rooms.xml scenes/glass_lamp.xml \
        path auto bdpt --size 160x90 --spp 80 --seeds 3 \
        --reference-integrator bdpt --reference-spp 1024 --out $(DEMO_OUT)

# One process per core (1 GiB of memory each), each with one thread of Dr.Jit. A process that is done
# takes over tests that others have not begun.
PYTEST := $(BIN)/python -m pytest -q -n logical --maxprocesses 8 --dist worksteal

.PHONY: demo test test-slow bench docs stubs lint setup clean

demo: setup
	$(DEMO)
	@echo "Open $(DEMO_OUT)/report.html in a browser."

test: setup
	$(PYTEST)

test-slow: setup
	$(PYTEST) -m slow

bench: setup
	$(BIN)/python benchmarks/benchmark.py

docs: setup $(VENV)/.installed_docs
	rm -rf out/docs
	$(BIN)/python -m sphinx -q -E -W --keep-going -d out/docs_work/pages -c docs/site . out/docs
	$(BIN)/python docs/site/check.py out/docs
	@echo "Open out/docs/index.html in a browser."

# The signatures of mitsuba_ext.scene_description, from the pages of the plugins
stubs: setup
	$(BIN)/python -m mitsuba_ext.scene_description.stub

lint: setup
	$(BIN)/python -m ruff check .

# The package in its environment, and an LLVM library that works (to check this takes milliseconds).
setup: $(VENV)/.installed
	@$(BIN)/python -I -m mitsuba_ext.startup.llvm_install --ensure

$(VENV)/.installed: pyproject.toml setup.py
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 9))' || \
	    { echo "Python 3.9 or newer is needed: run make PYTHON=/path/to/python3 to name one." >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	    { echo "$(PYTHON) cannot make virtual environments: run \`sudo apt install python3-venv\`." >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@

$(VENV)/.installed_docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
