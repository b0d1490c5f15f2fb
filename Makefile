# Two commands for a newcomer: `make demo` and `make test`. Both are idempotent and need no root.
# The first of these Pythons that fits; PYTHON=... names another. PyBullet has wheels for 3.10 and 3.11 on Linux x86-64.
VENV := .venv
BIN := $(VENV)/bin
FITS := -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null
PYTHON ?= $(shell for name in python3.11 python3.10 python3 python; do "$$name" $(FITS) && { echo "$$name"; break; }; done)
DEMO_EPISODES ?= 100
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo paper ablations leaning beyond engines test check docs bench torture clean

demo: $(VENV)/.installed  ## an arm trained in a minute; then method C for a short budget, tests on the 100 positions, the report
	$(BIN)/uarm-rl train experiment=fast results_dir=demo resume=true
	$(BIN)/uarm-rl evaluate results_dir=demo
	$(BIN)/uarm-rl train experiment=C episodes=$(DEMO_EPISODES) results_dir=demo resume=true
	$(BIN)/uarm-rl evaluate results_dir=demo
	$(BIN)/uarm-rl evaluate policy=ik results_dir=demo
	[ -f demo/adaptive-penalty/seed0/episode.gif ] || $(BIN)/uarm-rl render run=demo/adaptive-penalty/seed0
	$(BIN)/uarm-rl report results_dir=demo

# The paper's experiment and the ablations. Every line skips what is finished and continues what was interrupted, two runs
# at a time. OVERRIDES="..." reaches every training: a whole rehearsal is a matter of minutes with small numbers.
RESULTS ?= results
SEEDS ?= 0,1,2
METHODS ?= A,B,C,D,real_arm,rigid_arm
# Each is a file in conf/experiment that holds what it varies.
STUDIES ?= observability_long,long_servo,reference,halves,fixed_hold,servo,instant,sigma,gamma,tolerance,dwell,damping,beta,threshold,observability,actions,semi_markov,n_step,every_step,prioritized,learners,hindsight,learned_duration,learned_duration_by_time
SIDE_BY_SIDE ?= hydra/launcher=joblib hydra.launcher.n_jobs=2 simulate_beside=false
TRAIN = $(BIN)/uarm-rl train -m resume=true $(SIDE_BY_SIDE)
EVALUATE = $(BIN)/uarm-rl evaluate results_dir=$(RESULTS)

paper: $(VENV)/.installed-launch  ## all runs of the paper, all tests, the report; about 7 hours on two cores
	$(TRAIN) results_dir=$(RESULTS) experiment=$(METHODS) seed=$(SEEDS) $(OVERRIDES)
	$(EVALUATE) traces=3
	$(EVALUATE) tolerance_m=1e-3 out=tolerance-1mm.csv
	$(EVALUATE) tolerance_m=2e-3 out=tolerance-2mm.csv
	$(EVALUATE) tolerance_m=10e-3 out=tolerance-10mm.csv
	$(EVALUATE) until=time_limit positions=validation out=settled-validation.csv
	$(EVALUATE) until=time_limit out=settled.csv
	$(EVALUATE) positions=heldout out=heldout.csv
	$(EVALUATE) hold=one_step out=hold-one_step.csv
	$(EVALUATE) hold=fixed out=hold-fixed.csv
	$(EVALUATE) hold=until_steady out=hold-until_steady.csv
	$(EVALUATE) object=ghost out=ghost.csv
	$(EVALUATE) cup=bellows out=bellows.csv
	$(EVALUATE) cup=bellows object=ghost out=bellows-ghost.csv
	$(EVALUATE) policy=ik traces=3
	$(EVALUATE) policy=ik tolerance_m=1e-3 out=tolerance-1mm.csv
	$(EVALUATE) policy=ik tolerance_m=2e-3 out=tolerance-2mm.csv
	$(EVALUATE) policy=ik tolerance_m=10e-3 out=tolerance-10mm.csv
	$(EVALUATE) policy=ik until=time_limit out=settled.csv
	$(EVALUATE) policy=ik positions=heldout out=heldout.csv
	$(EVALUATE) policy=ik object=ghost out=ghost.csv
	$(EVALUATE) policy=ik cup=bellows out=bellows.csv
	$(EVALUATE) policy=ik cup=bellows object=ghost out=bellows-ghost.csv
	$(BIN)/uarm-rl report results_dir=$(RESULTS)

ablations: $(VENV)/.installed-launch  ## the shorter runs that say why it works, and the report; about 25 hours on two cores
	$(TRAIN) results_dir=$(RESULTS)/ablations experiment=$(STUDIES) seed=$(SEEDS) $(OVERRIDES)
	$(BIN)/uarm-rl evaluate results_dir=$(RESULTS)/ablations overwrite=true
	$(BIN)/uarm-rl report results_dir=$(RESULTS)

leaning: $(VENV)/.installed-launch  ## the paper's methods with a cup that gives, and the report; about 40 minutes on two cores
	$(TRAIN) results_dir=$(RESULTS)/bellows experiment=A,B,C,D seed=$(SEEDS) cup=bellows episodes=300 $(OVERRIDES)
	$(EVALUATE)/bellows
	$(EVALUATE)/bellows object=ghost out=ghost.csv
	$(BIN)/uarm-rl report results_dir=$(RESULTS)

beyond: $(VENV)/.installed-plan  ## obstacles and torques, and the report; about 3 hours on two cores
	$(TRAIN) results_dir=$(RESULTS)/beyond experiment=obstacles buffer=adaptive seed=$(SEEDS) $(OVERRIDES)
	$(TRAIN) results_dir=$(RESULTS)/beyond experiment=obstacles buffer=uniform episodes=80 experiences_per_episode=300 validate_every=8 checkpoint_every=8 seed=$(SEEDS) $(OVERRIDES)
	$(TRAIN) results_dir=$(RESULTS)/beyond experiment=torque buffer=uniform,steady_speed seed=$(SEEDS) $(OVERRIDES)
	$(TRAIN) results_dir=$(RESULTS)/beyond experiment=torque buffer=adaptive episodes=200 seed=$(SEEDS) $(OVERRIDES)
	$(TRAIN) results_dir=$(RESULTS)/arm experiment=obstacles_arm seed=0 $(OVERRIDES)
	$(EVALUATE)/arm
	$(EVALUATE)/beyond traces=1
	$(BIN)/uarm-rl evaluate run=$(RESULTS)/beyond/obstacles-adaptive/seed0 policy=ik out=$(RESULTS)/beyond/obstacles-adaptive/seed0/ik.csv
	$(BIN)/uarm-rl evaluate run=$(RESULTS)/beyond/obstacles-adaptive/seed0 policy=planner out=$(RESULTS)/beyond/obstacles-adaptive/seed0/planner.csv
	$(BIN)/uarm-rl report results_dir=$(RESULTS)

engines: $(VENV)/.installed-engines  ## the paper's policies in MuJoCo too, C and D trained there, and the report; about 30 minutes on two cores
	$(TRAIN) results_dir=$(RESULTS)/mujoco experiment=C,D seed=$(SEEDS) sim=mujoco episodes=300 $(OVERRIDES)
	$(EVALUATE)/mujoco
	$(EVALUATE)/mujoco sim=pybullet out=pybullet.csv
	$(EVALUATE) sim=mujoco out=mujoco.csv
	$(EVALUATE) policy=ik sim=mujoco out=mujoco.csv
	$(BIN)/python benchmarks/engines.py --out $(RESULTS)/mujoco/trajectories.csv
	$(BIN)/uarm-rl report results_dir=$(RESULTS)

test: $(VENV)/.installed-test  ## the whole test suite
	$(BIN)/python -m pytest -n 2

check: $(VENV)/.installed-dev  ## formatting, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: $(VENV)/.installed-docs  ## the documentation and the API, into build/docs/index.html; some two minutes
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -b html docs build/docs

bench: $(VENV)/.installed-bench  ## speed, as ratios measured side by side, and the minute of experiment=fast; about 15 minutes
	$(BIN)/python benchmarks/bench.py
	$(BIN)/python benchmarks/fast.py

torture: $(VENV)/.installed-test  ## kill trainings and machines, fail saves, damage files, hostile input; about 40 minutes
	$(BIN)/python -m tests.torture --out tests/torture.csv

$(VENV)/bin/python:
	@"$(PYTHON)" $(FITS) || { echo "uarm-rl needs Python 3.10 to 3.14, and $(or $(PYTHON),what is here) is none of them: install one, or name it with PYTHON=/path/to/python3"; exit 1; }
	$(PYTHON) -m venv $(VENV)

# The stamps go stale when what is installed changes; the editable install follows the code by itself.
$(VENV)/.installed: $(VENV)/bin/python setup.cfg pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	@touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed-test
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

$(VENV)/.installed-launch: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[launch]'
	@touch $@

$(VENV)/.installed-engines: $(VENV)/.installed-launch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[mujoco]'
	@touch $@

$(VENV)/.installed-plan: $(VENV)/.installed-launch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[plan]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	@touch $@

$(VENV)/.installed-bench: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	@touch $@

clean:
	rm -rf $(VENV) build demo *.egg-info
