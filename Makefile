# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PYTEST := $(BIN)/python -m pytest
GPU ?= cu12
WORKERS ?= 3
unexport PYTHONDONTWRITEBYTECODE  # otherwise, each of hundreds of processes compiles every module again
export PIP_DISABLE_PIP_VERSION_CHECK := 1
ELSEWHERE := --ignore=tests/cuda --ignore=tests/ptx --ignore=tests/kernels
CORE := base settings geometry frames chain analysis pipeline

.PHONY: demo test test-core test-kernels test-host test-simulator test-ptx test-arm check docs reference data notebooks pictures bench peers soak gpu release clean

$(VENV)/ready: setup.cfg pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.'
	touch $@

$(VENV)/ready-to-test: $(VENV)/ready  # packages for tests and checks, of which CUDA's compilers are 0.7 GB
	$(BIN)/python -m pip install --quiet --editable '.[test,check,docs]'
	touch $@

demo: $(VENV)/ready
	$(BIN)/ertis demo --force

ifdef ROOM  # make test ROOM=figures: the tests of one room
test: $(VENV)/ready-to-test
	$(PYTEST) -m "not alone" --numprocesses $(WORKERS) --dist worksteal tests/$(ROOM)
else  # Two groups run at a time, and each prints its result when it ends. Tests that measure times run last, alone.
test: $(VENV)/ready-to-test
	$(MAKE) --no-print-directory --jobs 2 --keep-going --output-sync=target test-kernels test-ptx test-host test-simulator
	$(PYTEST) -m alone $(ELSEWHERE)
endif

test-core: $(VENV)/ready-to-test  ## test the rooms from bits to images, but for the kernels
	$(PYTEST) -m "not alone" --numprocesses $(WORKERS) --dist worksteal $(CORE:%=tests/%)

test-kernels: $(VENV)/ready-to-test  # compile all kernels in one process, because parallel processes could corrupt the cache
	$(PYTEST) -m "not alone" tests/kernels

test-host: test-kernels  # one worker more than two cores, because some tests wait for sockets and disks
	$(PYTEST) -m "not alone" --numprocesses $(WORKERS) --dist worksteal $(ELSEWHERE)

test-simulator: test-kernels
	NUMBA_ENABLE_CUDASIM=1 $(PYTEST) tests/cuda tests/kernels -k cuda

test-ptx: $(VENV)/ready-to-test
	$(PYTEST) tests/ptx

test-arm: $(VENV)/ready-to-test  ## test the kernels on emulated aarch64; needs Debian and 1 GB in build/arm
	$(BIN)/python -m tests.arm build/arm

check: $(VENV)/ready-to-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(PYTEST) -q tests/cli/test_plain_english.py tests/cli/test_docstring_examples.py
	$(BIN)/python -m sphinx -q -W --keep-going docs site

docs: $(VENV)/ready-to-test  ## build the documentation; open site/index.html
	$(BIN)/python -m sphinx -q -W --keep-going docs site

reference: $(VENV)/ready  ## rewrite the generated parts of the reference pages
	$(BIN)/python docs/reference/build.py

data: $(VENV)/ready  ## rebuild data/synthetic from its scenes, and the gallery
	$(BIN)/python data/build.py
	$(BIN)/python data/hall.py
	$(BIN)/python data/gallery.py

notebooks: $(VENV)/ready-to-test  ## run the notebooks and store their texts
	$(BIN)/python docs/notebooks/build.py

pictures: $(VENV)/ready  ## redraw the pictures of the README; the viewer needs Chromium
	$(BIN)/python -m pip install --quiet --editable '.[view,browser]'
	$(BIN)/python docs/pictures/build.py
	$(BIN)/python docs/pictures/view.py

bench: $(VENV)/ready  ## run the benchmarks and update the tables in the documentation
	$(BIN)/ertis bench paper --update docs/reference/benchmarks.md --update README.md
	$(BIN)/ertis bench accuracy --update docs/reference/benchmarks.md --update docs/explanation/accuracy.md --plot docs/pictures/front.png
	$(BIN)/ertis bench beamformers --update docs/explanation/beamformers.md
	$(BIN)/ertis bench verification --update docs/explanation/accuracy.md
	$(BIN)/ertis bench points --update docs/explanation/accuracy.md
	$(BIN)/ertis bench calibration --update docs/how-to/calibrate.md
	$(BIN)/ertis bench fusion --seed 1000 --update docs/how-to/fusion.md
	$(BIN)/ertis bench fusion --only calls --count 6 --seed 1000 --update docs/how-to/fusion.md
	$(BIN)/ertis bench fusion --only clocks --update docs/how-to/fusion.md
	$(BIN)/ertis bench fusion --only delays --count 6 --seed 1000 --update docs/how-to/fusion.md
	$(BIN)/ertis bench fusion --only scans --count 24 --seed 1000 --update docs/how-to/fusion.md
	$(BIN)/ertis bench fusion --only emitters --count 24 --seed 9500 --update docs/how-to/fusion.md
	$(BIN)/ertis bench fusion --only reflections --count 50 --seed 9000 --update docs/how-to/fusion.md
	$(BIN)/ertis bench network --only fusion --update docs/how-to/fusion.md
	$(BIN)/ertis bench network --only maps --update docs/how-to/passive.md
	$(BIN)/ertis bench motion --length 90 --seed 2000 --update docs/how-to/motion.md
	$(BIN)/ertis bench motion --only scenes --count 10 --seed 9500 --update docs/how-to/motion.md
	$(BIN)/ertis bench map --update docs/how-to/mapping.md
	$(BIN)/ertis bench map --only space --update docs/how-to/mapping.md
	$(BIN)/ertis bench map --only shifts --update docs/how-to/mapping.md
	$(BIN)/ertis bench scaling --update docs/reference/benchmarks.md
	$(BIN)/ertis bench simulation --update docs/reference/benchmarks.md
	$(BIN)/ertis bench many --update docs/how-to/many.md
	$(BIN)/ertis bench network --update docs/explanation/network-guarantees.md
	$(BIN)/ertis bench latency --update docs/explanation/network-guarantees.md
	$(BIN)/ertis bench capacity --update docs/explanation/capacity.md

peers: $(VENV)/ready  ## compare with Acoular, PyTorch and JAX; on Linux, PyTorch from PyPI brings CUDA libraries
	$(BIN)/python -m pip install --quiet --editable '.[peers]'
	$(BIN)/ertis bench peers --update docs/reference/benchmarks.md
	$(BIN)/ertis bench passive --update docs/explanation/acoustic-maps.md

soak: $(VENV)/ready-to-test  ## test faults, kills, full disks and random scenes for hours; SEED=N repeats a run
	$(BIN)/python -m tests.faults reliability --long $(if $(SEED),--seed $(SEED)) --update docs/explanation/reliability.md
	$(BIN)/python -m tests.faults network --long $(if $(SEED),--seed $(SEED)) --update docs/explanation/network-guarantees.md
	$(BIN)/ertis bench simulation --verdicts 1000
	$(BIN)/ertis bench budgets --count 300
	ERTIS_EXAMPLES=3000 $(PYTEST) --timeout 0 tests/hard_cases/test_any_settings.py

gpu: $(VENV)/ready  ## test and time this machine's NVIDIA GPU in less than ten minutes; GPU=cu13 for CUDA 13
	$(BIN)/python -m pip install --quiet --editable '.[test,$(GPU)]'
	$(BIN)/ertis bench gpu --results bench/results --update docs/explanation/gpu.md

release: $(VENV)/ready  ## build the distributions of the last commit in dist, and try them in empty environments
	$(BIN)/python -m pip install --quiet --editable '.[release]'
	$(BIN)/cffconvert --validate
	$(BIN)/python -c "from rattler_build import Stage0Recipe; Stage0Recipe.from_file('conda/recipe.yaml').render()"
	$(BIN)/python -m tests.release dist docs/how-to/install.md

clean:
	rm -rf $(VENV) build dist *.egg-info demo site
