# Everything runs in .venv, made on first use: jaxcal and what training needs, then every
# line of constraints.txt. uv takes half of pip's time for them; where it cannot reach
# the packages, pip, whose configuration may say where they are, installs them. Python
# compiles what it imports; compiling everything takes as long again as installing it.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV ?= .venv
BENCH ?= .venv-bench
BIN := $(VENV)/bin
TRAINS := $(VENV)/.trains
READY := $(VENV)/.ready
PIP := $(BIN)/python -m pip install --quiet --no-compile
install = { $(BIN)/uv pip install --quiet --python $(VENV) $(1) || $(PIP) $(1); }
new_enough = test -n "$(PYTHON)" && $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	{ echo "jaxcal needs Python 3.11 or newer, got $(PYTHON): make PYTHON=/path/to/python3.11"; exit 2; }
KERNELS := hatch_build.py $(shell find jaxcal -name '*kernel.py' -o -name '*.pxd')

# XLA's flags for quick compiling, asked of what is installed when a recipe runs. Newer
# versions end at the second flag, and with the first their loss is NaN.
QUICK_XLA = $$($(BIN)/python -c 'import importlib.metadata as m; print(\
	"--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false" \
	" --xla_cpu_parallel_codegen_split_count=1" \
	* m.version("jaxlib").startswith("0.10."))')

.DEFAULT_GOAL := help
.PHONY: help train checkpoint evaluate reproduce test test-all lint format benchmark docs docs-serve release-check clean

help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F':.*## ' '{printf "  make %-13s %s\n", $$1, $$2}'

$(TRAINS): pyproject.toml constraints.txt $(KERNELS)
	@$(new_enough)
	$(PYTHON) -m venv $(VENV)
	$(PIP) -c constraints.txt uv
	$(call install,-c constraints.txt -e '.[policy]')
	@touch $@

$(READY): $(TRAINS)
	$(call install,--no-deps -r constraints.txt)
	$(BIN)/python -m pip check
	@touch $@

train: $(TRAINS) ## set everything up and train the compact policy on this machine (one to two minutes)
	$(BIN)/python train.py $(ARGS)

checkpoint: $(TRAINS) ## train the policy that ships and put it in checkpoints/default.npz (about 10 minutes)
	$(BIN)/python train.py --preset general --export checkpoints/default.npz $(ARGS)

evaluate: $(READY) ## compare every method with the proven optimum on 1,000 unseen candidate sets
	$(BIN)/python evaluate.py $(ARGS)

reproduce: $(READY) ## the paper's figures, tables and claims from our own runs, in report/index.html
	$(BIN)/python -m benchmarks.paper $(ARGS)

# Most of a first run is XLA compiling: without its optimiser that takes a third of the
# time. In `make test-all` adaptive and learning compile so, the others as users do.
# Hundreds of programs are started: what one has compiled the others load.
test: export PYTHONDONTWRITEBYTECODE =
# The rig's tests mostly wait for a device and import no JAX: three processes of them run
# beside the linters and two processes of the others, which compile and give way: a device
# that is silent for a tenth of a second is a fault. Nothing that failed is run again. Files
# stay in order:
# xdist would put the files of few long tests last. Each process would compile everything
# that the tests import: one does it before, while mypy runs.
QUICK_TESTS = $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder -m 'not slow' $(ARGS)
QUICK_RIG_TESTS = $(QUICK_TESTS) -o cache_dir=$(VENV)/rig-cache tests/rig
test: $(READY) ## set everything up, lint, and run the quick tests (the ones CI runs)
	@$(QUICK_RIG_TESTS) -n 3 >$(VENV)/rig-tests.log 2>&1 & rig=$$!; \
	nice $(BIN)/python -m pytest --collect-only -qq >/dev/null & imports=$$!; \
	nice $(MAKE) --no-print-directory lint || { kill $$rig $$imports; exit 1; }; wait $$imports; \
	export XLA_FLAGS="$${XLA_FLAGS-$(QUICK_XLA)}"; \
	nice $(QUICK_TESTS) -n 2 tests --ignore tests/rig; others=$$?; \
	wait $$rig; rig=$$?; cat $(VENV)/rig-tests.log; \
	exit $$((rig | others))

# A part is a folder of tests/, `files`, the tests beside them, or `trainings`, those of
# adaptive and learning that need the speed of an optimised program. Each is a run of its
# own: what one process has compiled it keeps, and the whole suite is too much for one. The
# rig's part, which mostly waits, runs beside the others, which give way. Nothing that
# failed is run again.
PARTS ?= $(notdir $(patsubst %/,%,$(dir $(wildcard tests/*/test_*.py)))) files trainings
EVERY_TEST = $(BIN)/python -m pytest --hypothesis-profile=new -m 'not trains' --dist loadfile --no-loadscope-reorder \
	--durations=5 --durations-min=60 $(ARGS)
RIG_TESTS = $(EVERY_TEST) -o cache_dir=$(VENV)/rig-cache tests/rig
test-all: $(READY) lint ## every test, the slow ones too, hypothesis drawing new examples (some folders: PARTS="rig docs")
	@failed=; if [ "$(filter rig,$(PARTS))" ]; then \
	$(RIG_TESTS) -n 2 --dist load >$(VENV)/rig-tests.log 2>&1 & fi; rig=$$!; \
	for part in $(filter-out rig,$(sort $(PARTS))); do echo "== $$part"; \
	flags="$$XLA_FLAGS"; case $$part in files) tests="--dist load `ls tests/test_*.py`";; \
	trainings) tests="-m trains tests/adaptive tests/learning";; *) tests=tests/$$part;; esac; \
	case $$part in adaptive|learning) flags="$${XLA_FLAGS-$(QUICK_XLA)}";; esac; \
	XLA_FLAGS="$$flags" nice -n 19 $(EVERY_TEST) -n 2 $$tests || failed="$$failed $$part"; done; \
	if [ "$$rig" ]; then wait $$rig; rig=$$?; echo "== rig"; cat $(VENV)/rig-tests.log; \
	[ $$rig = 0 ] || failed="$$failed rig"; fi; \
	[ -z "$$failed" ] || { echo "failed:$$failed"; exit 1; }

# On a busy machine mypy's processes may not find each other in time (exit 2).
lint: $(READY) ## ruff (lint and format), mypy and the import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	{ $(BIN)/mypy || { [ $$? = 2 ] && $(BIN)/mypy --num-workers 0; }; } & mypy=$$!; $(BIN)/lint-imports; imports=$$?; wait $$mypy && exit $$imports

format: $(READY) ## let ruff rewrite what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The peers live in an environment of their own, so that they constrain nobody else.
$(BENCH)/.ready: pyproject.toml constraints.txt constraints-bench.txt
	@$(new_enough)
	$(PYTHON) -m venv $(BENCH)
	$(BENCH)/bin/python -m pip install --quiet -c constraints.txt -c constraints-bench.txt -e '.[all,dev,bench]'
	@touch $@

benchmark: $(BENCH)/.ready ## every benchmark with its peers: table, JSON, figures (36 to 50 minutes; ARGS="--only steps", "--quick")
	$(BENCH)/bin/python -m benchmarks $(ARGS)

docs: $(READY) ## the documentation site in site/, strictly and without a network
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build $(ARGS)

docs-serve: $(READY) ## the site at http://127.0.0.1:8000, built again at each change
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve $(ARGS)

release-check: $(READY) ## wheel and sdist in fresh environments of Python 3.11, 3.12, 3.13 (or ARGS="INTERPRETER...")
	$(BIN)/python tests/release_check.py $(ARGS)

clean: ## remove the virtual environment and caches
	rm -rf $(VENV) $(BENCH) build site .cache .mypy_cache .ruff_cache .pytest_cache
