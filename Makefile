# Everything a newcomer needs: `make fly` and `make test`. Each sets up its own environment in .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
MISSION ?= configs/corridor.yaml
# numba, torch and onnxruntime each start a thread pool; on small machines they only get in each other's way
export OMP_NUM_THREADS ?= 1
export NUMBA_NUM_THREADS ?= 1

.PHONY: fly test bench lint setup-fly setup-dev clean

fly: $(VENV)/.setup-fly  ## set up what a simulated flight needs, then fly the mission
	$(BIN)/fly --mission $(MISSION)

test: $(VENV)/.setup-dev lint  ## set up everything, then lint, types and all tests
	@echo "== safety layer: its own tests run every line and branch, or this fails =="
	$(BIN)/python -m pytest -n 2 -q tests/safety --cov=safety --cov-branch --cov-report=term-missing:skip-covered --cov-fail-under=100 || \
		{ echo "== what failed, once more with other random examples; lines that no test ran fail here too =="; rm -rf .hypothesis; \
		  $(BIN)/python -m pytest --last-failed --last-failed-no-failures none -q tests/safety; }
	@echo "== all other tests, two at a time (simulated and pure) =="
	$(BIN)/python -m pytest -n 2 -m "not realtime" -q --ignore tests/safety || \
		{ echo "== what failed beside other tests, once more and alone: these machines are shared =="; \
		  $(BIN)/python -m pytest --last-failed --last-failed-no-failures none -m "not realtime" -q --ignore tests/safety; }
	@echo "== tests that fly in real time over MAVLink, one at a time =="
	$(BIN)/python -m pytest -m realtime -v || \
		{ echo "== what failed, once more: a shared machine can stall a flight; what fails twice is no accident =="; \
		  $(BIN)/python -m pytest --last-failed --last-failed-no-failures none -m realtime -v; }

lint: $(VENV)/.setup-dev
	@echo "== ruff =="
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@echo "== mypy =="
	$(BIN)/mypy

bench: $(VENV)/.setup-dev  ## every benchmark, as ratios within this run
	$(BIN)/python -m benchmarks all

setup-fly: $(VENV)/.setup-fly
setup-dev: $(VENV)/.setup-dev

$(BIN)/python:
	@echo "== creating the environment $(VENV) =="
	$(PYTHON) -m venv $(VENV)

$(VENV)/.setup-fly: pyproject.toml constraints.txt | $(BIN)/python
	@echo "== installing the flight stack, the simulator, recording and the plots (no torch) =="
	$(BIN)/python -m pip install --disable-pip-version-check --progress-bar off -c constraints.txt -e ".[sim,report,record]"
	@touch $@

$(VENV)/.setup-dev: pyproject.toml constraints.txt | $(BIN)/python
	@echo "== installing everything, the trainer and the test tools included =="
	$(BIN)/python -m pip install --disable-pip-version-check --progress-bar off -c constraints.txt -e ".[dev]"
	@touch $@ $(VENV)/.setup-fly

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
