# All commands of the project. `make` alone lists them.
#
# The first use creates .venv and installs what the scripts need, and for tests and checks the
# rest; later uses do so only if pyproject.toml has changed. Variables on the command line:
#   PYTHON=/path/to/python3.11     the Python for .venv; by default the first suitable one
#   TORCH_INSTALL_ARGS='...'       arguments of `pip install` for another build of PyTorch, which
#                                  is installed before the project: the wheel file of a CPU
#                                  build, or 'torch==2.15.* --index-url URL-OF-CPU-BUILDS';
#                                  others than the last ones install again
#   ARGS='method=per seed=1'       settings for demo and train, options for test and bench
#   REGIME=paper                   train: the paper's task and numbers; default: rooms
#   DEMO_ACTIONS=30000             length of demo's training, in actions
#   EPISODES=20                    evaluation episodes of demo in the worlds of each generator
#   SLOW=1                         test: include the slow tests
#   WORKERS=4                      test: number of processes, 2 by default; 0: one, with live output

SHELL := /bin/sh
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo train paper test check lint types doctest format docs bench wheel-test clean

PYTHON ?=
TORCH_INSTALL_ARGS ?=
ARGS ?=
REGIME ?= rooms
DEMO_ACTIONS ?= 30000
EPISODES ?= 20
SLOW ?=
WORKERS ?= 2

VENV := .venv
BIN := $(VENV)/bin
# What the scripts need, and with it what tests and checks need.
STAMP := $(VENV)/.installed
DEV := $(VENV)/.installed-dev
TORCH := $(VENV)/.torch-args
PYTEST := $(BIN)/python -m pytest
DOCTESTS := --doctest-modules torchrl_mpfa envs
# Together with the tests, as each process of pytest needs seconds to import PyTorch.
ALSO := $(if $(filter check,$(MAKECMDGOALS)),$(DOCTESTS) tests)

# This project needs Python 3.10, and PyBullet has wheels up to 3.11; on later versions everything
# but the simulated wheels works. Interpreters are run to find their version rather than trusted by
# name: shims of version managers may exist but not work.
CANDIDATES := python3.11 python3.10 python3 python python3.13 python3.12
FITS := import sys, venv, ensurepip; sys.exit(sys.version_info[:2] not in ((3, 10), (3, 11)))
LATER := import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 12))
HOME_OF := import sys; print(sys.base_prefix, sys.version_info[:2])
WAY_OUT := install Python 3.11 and run: make PYTHON=/path/to/python3.11 $(or $(MAKECMDGOALS),test)
NO_WHEELS := is later than Python 3.11, so that there is no PyBullet and no simulated wheels; demo and train use physics=kinematic
# Arguments of the scripts on such a Python, evaluated when they are called: there may be no .venv before.
EVALUATED = `$(BIN)/python -c "import sys; print('kinematic' if sys.version_info >= (3, 12) else 'wheels')"`
PHYSICS = `$(BIN)/python -c "import sys; print('environment.physics=kinematic' * (sys.version_info >= (3, 12)))"`

# Pip shows its progress where someone looks.
INSTALL = quiet=-q; [ ! -t 1 ] || quiet=; $(BIN)/python -m pip install $$quiet

help: ## Print this list
	@echo "usage: make TARGET"
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/\1|\2/p' Makefile | \
	  while IFS='|' read -r target text; do printf '  %-12s %s\n' "$$target" "$$text"; done
	@echo "variables: PYTHON, TORCH_INSTALL_ARGS, ARGS, REGIME, DEMO_ACTIONS, EPISODES, SLOW, WORKERS; see the top of the Makefile"

demo: $(STAMP) ## Train DDPG with MPFA-PER for a minute, and evaluate it in unseen rooms
	@echo "== training $(DEMO_ACTIONS) actions in rooms that are new each episode; Ctrl-C stops and saves"
	@$(BIN)/python examples/train.py run_dir=runs/demo overwrite=true tracking=off actions=$(DEMO_ACTIONS) $(ARGS)
	@echo "== driving $(EPISODES) tasks in unseen worlds of each generator, a minute"
	@$(BIN)/python examples/evaluate.py runs/demo --worlds all --episodes $(EPISODES) --physics $(EVALUATED) --filter
	@cd runs/demo/evaluation-all-$(EVALUATED)-filter && cp evaluation.json trajectories.png episode.gif ..
	@echo "look at runs/demo/trajectories.png, and at runs/demo/episode.gif, the longest of these drives"
	@echo "next: $(BIN)/python examples/play.py runs/demo --worlds mazes:test    a race against it by keyboard"

train: $(STAMP) ## Train with a new room each episode (minutes); REGIME=paper: the paper's task (tens of minutes)
	$(BIN)/python examples/train.py regime=$(REGIME) $(PHYSICS) $(ARGS)

paper: $(STAMP) ## Write docs/results/paper.md and its figures from the kept rows of the paper's runs
	$(BIN)/python -m benchmarks.paper $(ARGS)

test: $(DEV) ## Run the tests; SLOW=1 adds the slow ones, ARGS='-k tree' selects
	$(PYTEST) -n $(WORKERS) --dist worksteal $(if $(filter-out 0,$(SLOW)),-m 'slow or not slow') $(ALSO) $(ARGS)

check: lint types test ## Check format, lint, types, doctests and tests

lint: $(DEV)
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m ruff check .

types: $(DEV)
	$(BIN)/python -m mypy

doctest: $(DEV)
	$(PYTEST) $(DOCTESTS)

format: $(DEV) ## Format the code and fix what ruff can fix
	$(BIN)/python -m ruff format .
	$(BIN)/python -m ruff check --fix .

docs: $(DEV) ## Build the documentation site; open site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo "written: site/index.html"

bench: $(DEV) ## Measure against TorchRL's own parts (minutes); ARGS='--quick'
	$(BIN)/python -m benchmarks.speed $(ARGS)

wheel-test: $(DEV) ## Build sdist and wheel, install the wheel elsewhere and test it
	$(BIN)/python .ci/wheel_test.py

clean: ## Remove builds and caches; runs/ and .venv stay
	rm -rf dist build site .mypy_cache .pytest_cache .ruff_cache .coverage benchmarks/speed/latest.json
	find . -name .venv -prune -o -name .git -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

# Another Python than that of .venv is not ignored: it is installed for.
ifneq ($(PYTHON),)
ifneq ($(wildcard $(STAMP)),)
ifneq ($(shell $(BIN)/python -c "$(HOME_OF)" 2>/dev/null),$(shell "$(PYTHON)" -c "$(HOME_OF)" 2>/dev/null))
.PHONY: $(STAMP)
endif
endif
endif

# Nor are other arguments for PyTorch than those that it was installed with.
ifneq ($(strip $(TORCH_INSTALL_ARGS)),)
ifneq ($(strip $(TORCH_INSTALL_ARGS)),$(strip $(shell cat $(TORCH) 2>/dev/null)))
.PHONY: $(STAMP)
endif
endif

# The stamp is written last, so that an interrupted installation is repeated.
$(STAMP): pyproject.toml
	@rm -f $(STAMP); \
	if [ -n "$(PYTHON)" ]; then \
	  python="$(PYTHON)"; \
	  if ! "$$python" -c "$(FITS)" >/dev/null 2>&1 && ! "$$python" -c "$(LATER)" >/dev/null 2>&1; then \
	    echo "make: PYTHON=$(PYTHON) is not a Python 3.10 or later that runs and can make a venv; $(WAY_OUT)" >&2; exit 1; \
	  fi; \
	else \
	  python=; \
	  for wanted in "$(FITS)" "$(LATER)"; do \
	    for candidate in "$(BIN)/python" $(CANDIDATES); do \
	      case "$$candidate" in $(BIN)/*) wanted="import pip; $$wanted" ;; esac; \
	      [ -n "$$python" ] || ! "$$candidate" -c "$$wanted" >/dev/null 2>&1 || python="$$candidate"; \
	      wanted="$${wanted#import pip; }"; \
	    done; \
	  done; \
	  if [ -z "$$python" ]; then \
	    echo "make: no Python 3.10 or later found that runs and can make a venv; $(WAY_OUT)" >&2; exit 1; \
	  fi; \
	fi; \
	"$$python" -c "$(FITS)" >/dev/null 2>&1 || echo "make: $$python $(NO_WHEELS); $(WAY_OUT)" >&2; \
	home=`"$$python" -c "$(HOME_OF)"`; \
	if [ "`"$(BIN)/python" -c "import pip; $(HOME_OF)" 2>/dev/null`" != "$$home" ]; then \
	  echo "== making $(VENV) with $$python"; \
	  "$$python" -m venv --clear $(VENV) || exit 1; \
	fi
	@echo "== installing in $(VENV); the first time this downloads PyTorch, some gigabytes"
	$(if $(strip $(TORCH_INSTALL_ARGS)),@$(BIN)/python -m pip uninstall -qq -y torch)
	$(if $(strip $(TORCH_INSTALL_ARGS)),@$(INSTALL) $(TORCH_INSTALL_ARGS))
	$(if $(strip $(TORCH_INSTALL_ARGS)),@printf '%s\n' '$(subst ','\'',$(TORCH_INSTALL_ARGS))' > $(TORCH))
	@# Pip before 23.1, which comes with Python 3.10, does not find versions that fit each other.
	@$(INSTALL) 'pip>=23.1'
	@$(INSTALL) -e ".[examples]"
	@touch $(STAMP)

$(DEV): $(STAMP)
	@echo "== installing what tests and checks need in $(VENV)"
	@$(INSTALL) -e ".[dev]"
	@touch $(DEV)
