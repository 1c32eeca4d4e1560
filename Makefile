# Needs Python >= 3.11, pip and make. Everything goes into .venv.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO_STEPS ?= 60000

.PHONY: env env-newest demo wheel site guard test test-failed test-faults chaos test-long test-cluster test-container test-dm-control test-pybullet test-newest lint docs results-page bench peers clean

env: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "$(PYTHON) is too old: make PYTHON=python3.11 (or newer)")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet torch==2.13.0 -c constraints.txt
	$(BIN)/python -m pip install --quiet -e '.[dev]' -c constraints.txt
	@touch $(STAMP)

demo: $(STAMP)
	$(BIN)/rmc train HalfCheetah-v5 --total-steps $(DEMO_STEPS)

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder --durations=25 --durations-min=5

# Those that failed when they last ran, one after the other.
test-failed: $(STAMP)
	$(BIN)/python -m pytest --last-failed --last-failed-no-failures none

# The newest Python that every wheel resolves for, without torch, whose wheels there bring gigabytes of CUDA: all that
# never imports it, in an environment of its own.
NEWEST := 3.13
NEWEST_PYTHON ?= $(firstword $(wildcard $(HOME)/.pyenv/versions/$(NEWEST).*/bin/python) $(shell command -v python$(NEWEST)))
NEEDS_TORCH := common/test_process_state.py common/test_wire.py replay_server/test_process.py replay_server/test_recovery.py replay_server/test_server.py \
	replay_server/test_socket_server.py
WITHOUT_TORCH := import tomllib; project = tomllib.load(open("pyproject.toml", "rb"))["project"]; print(*(one for one in project["dependencies"] if not one.startswith("torch")), sep="\n")

env-newest: $(VENV)-$(NEWEST)/.packages

test-newest: $(VENV)-$(NEWEST)/.installed
	$(VENV)-$(NEWEST)/bin/python -m pytest -q -n 2 tests/common tests/cli/test_startup.py tests/replay_server $(addprefix --ignore tests/,$(NEEDS_TORCH))

$(VENV)-$(NEWEST)/.packages: pyproject.toml constraints.txt
	test -n "$(NEWEST_PYTHON)" || { echo "no Python $(NEWEST) here: make test-newest NEWEST_PYTHON=/path/to/python$(NEWEST)"; exit 1; }
	test -x $(@D)/bin/python || $(NEWEST_PYTHON) -m venv $(@D)
	$(NEWEST_PYTHON) -c '$(WITHOUT_TORCH)' > $(@D)/requirements.txt
	$(@D)/bin/python -m pip install --quiet -r $(@D)/requirements.txt pytest pytest-timeout pytest-xdist hypothesis -c constraints.txt
	@touch $@

# A step of its own: two that install the checkout at once would write the same files in it.
$(VENV)-$(NEWEST)/.installed: $(VENV)-$(NEWEST)/.packages
	$(@D)/bin/python -m pip install --quiet --no-deps -e .
	@touch $@

# The scripts of tests/faults at length, some three hours in all; each puts its rows into tests/faults/results.json.
# Linux; disk_full wants root, clock a C compiler.
FAULTS := fuzz fuzz_files broken_checkpoints kill_actor kill_replay kill_learner kill_redis kill_all nan_loss frozen disk_full clock \
	slow_learner soak

test-faults: $(addprefix test-faults-,$(FAULTS)) docs

test-faults-%: $(STAMP)
	$(BIN)/python -m tests.faults.$*

# All faults on top of each other, for so many hours, by a schedule that follows from the seed. Linux and root.
HOURS ?= 1
SEED ?= 0

chaos: $(STAMP)
	$(BIN)/python -m tests.faults.all_at_once --hours $(HOURS) --seed $(SEED)
	$(BIN)/python -m docs.fault_table

# The tests that take most of a minute or more, some ten minutes in all.
test-long: $(STAMP)
	$(BIN)/python -m pytest -m long --durations=25

# Real ray up on three machines that are namespaces of this one: Linux, root, openssh-server, rsync, iproute2.
ROUNDS ?= 5
CUTS ?= 5 30 90 240
ONLY ?= test

test-cluster: $(STAMP)
	for round in $$(seq $(ROUNDS)); do RMC_CUTS="$(CUTS)" $(BIN)/python -m pytest -x tests/cluster/on_machines.py -k "$(ONLY)" || exit; done

# The Dockerfile's steps in a chroot, some minutes and 2 GB: Linux, root, debootstrap. A network, or RMC_TORCH_INDEX and pip's settings.
test-container: $(STAMP)
	$(BIN)/python -m pytest -x tests/packaging/in_container.py

# In an environment of its own, .venv-dm-control: dm_control wants an older MuJoCo than the others' 4.
test-dm-control:
	test -x $(VENV)-dm-control/bin/python || $(PYTHON) -m venv $(VENV)-dm-control
	grep -v '^mujoco' constraints.txt > $(VENV)-dm-control/constraints.txt
	$(VENV)-dm-control/bin/python -m pip install --quiet torch==2.13.0 -c $(VENV)-dm-control/constraints.txt
	$(VENV)-dm-control/bin/python -m pip install --quiet -e '.[dm-control,dev]' -c $(VENV)-dm-control/constraints.txt
	$(VENV)-dm-control/bin/python -m pytest tests/common/test_dm_control.py

# The extra pybullet, 100 MB, in the same environment: Python 3.11.
test-pybullet: $(STAMP)
	$(BIN)/python -m pip install --quiet -e '.[pybullet]' -c constraints.txt
	$(BIN)/python -m pytest tests/common/test_pybullet_tasks.py

# mypy and import-linter read the packages as rmc.…: a tree of links that looks as an installed rmc does.
TREE := build/tree/rmc

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf $(TREE) && mkdir -p $(TREE) && ln -s $(CURDIR)/rmc/* $(addprefix $(CURDIR)/,actors analysis common deploy learner replay_server) $(TREE)
	$(BIN)/mypy
	cd build/tree && PYTHONPATH=. $(CURDIR)/$(BIN)/lint-imports --config $(CURDIR)/pyproject.toml

# A wheel and a source archive in dist/.
wheel: $(STAMP)
	rm -rf build/lib build/bdist.* dist
	$(BIN)/python -m build --no-isolation

# The documents as a site in build/site; every link is checked.
site: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs: $(STAMP)
	$(BIN)/python -m docs.generate
	$(BIN)/python -m docs.fault_table

# The tables and the picture of returns, from the lines in studies/results/ that docs/results.toml names.
results-page: $(STAMP)
	$(BIN)/python -m docs.results_page

# Short trainings beside the committed lines of earlier ones, for every change of a default: some 15 minutes, two quiet cores.
guard: $(STAMP)
	$(BIN)/python -m benchmarks.guard

# Each beside what a user would pick instead, where make peers has installed that. Results: docs/performance.md.
BENCHMARKS := replay ingest learner actor weights growth memory cuda end-to-end update-time pages

bench: $(addprefix bench-,$(BENCHMARKS))

bench-%: $(STAMP)
	$(BIN)/python -m benchmarks.$(subst -,_,$*)
	$(BIN)/python -m benchmarks.report

# Environments of their own: dm-reverb wants another TensorFlow and numpy than anybody else.
peers: $(VENV)-peers/.installed $(VENV)-reverb/.installed

$(VENV)-peers/.installed: Makefile
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet torch==2.13.0
	$(@D)/bin/python -m pip install --quiet stable-baselines3==2.9.2 sbx-rl==0.28.0 cpprb==11.0.0 'gymnasium[mujoco]'
	@touch $@

$(VENV)-reverb/.installed: Makefile
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet dm-reverb==0.14.0 tensorflow-cpu==2.15.1 numpy==1.26.4
	@touch $@

clean:
	rm -rf $(VENV) $(VENV)-* build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
