# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test check data pictures bench clean

$(VENV)/ready: setup.cfg pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[test,check]'
	touch $@

demo: $(VENV)/ready
	$(BIN)/ertis process data/synthetic/reflectors.h5 --output demo.h5 --directions 2d:181 --force
	$(BIN)/ertis peaks demo.h5 --top 5
	$(BIN)/ertis compare demo.h5
	$(BIN)/ertis plot demo.h5 --output demo.png --force

test: $(VENV)/ready
	$(BIN)/python -m pytest

check: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

data: $(VENV)/ready  ## rebuild data/synthetic from its scenes, and the gallery
	$(BIN)/python data/synthetic/build.py
	$(BIN)/python data/synthetic/gallery.py

pictures: $(VENV)/ready  ## redraw the pictures of the README
	$(BIN)/python docs/pictures/build.py

bench: $(VENV)/ready  ## measure this machine and write bench/README.md
	$(BIN)/ertis bench paper --update bench/README.md --update README.md
	$(BIN)/ertis bench accuracy --update README.md --update bench/README.md --plot docs/pictures/front.png
	$(BIN)/ertis bench factorisation --update docs/accuracy.md
	$(BIN)/ertis bench scaling --update bench/README.md
	$(BIN)/ertis bench simulation --update bench/README.md

clean:
	rm -rf $(VENV) build dist *.egg-info demo.h5 demo.png
