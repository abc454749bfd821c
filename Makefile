# One command each; every target builds its environment first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
CONSTRAINTS ?= constraints.txt
INSTALL = $(BIN)/python -m pip install --quiet --constraint $(CONSTRAINTS)
SOURCES := src tests benchmarks examples conftest.py docs/conf.py docs/_site.py \
  docs/names.py notebooks/execute.py
export MPLBACKEND := Agg

.PHONY: demo test lint types doctest bench notebooks docs slow clean

# pip's dependency groups (25.1) install what pyproject.toml lists for developers.
$(VENV)/.base: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "jrigid needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(INSTALL) --editable ".[demo]"
	touch $@

$(VENV)/.dev: $(VENV)/.base
	$(INSTALL) --group dev
	touch $@

$(VENV)/.docs: $(VENV)/.dev
	$(INSTALL) --group docs
	touch $@

demo: $(VENV)/.base
	$(BIN)/python examples/demo.py

test: $(VENV)/.dev
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal

slow: $(VENV)/.dev
	$(BIN)/python -m pytest -m slow

doctest: $(VENV)/.dev
	$(BIN)/python -m pytest --override-ini=addopts= --numprocesses 2 --doctest-modules src

lint: $(VENV)/.dev
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

types: $(VENV)/.dev
	$(BIN)/pyright

bench: $(VENV)/.dev
	-$(BIN)/python -m pip install --quiet --group peers
	$(BIN)/python benchmarks/run.py

notebooks: $(VENV)/.dev
	$(BIN)/python notebooks/execute.py

# The site, in build/docs/index.html; then every page of it is opened where there is a chromium.
docs: $(VENV)/.docs
	$(BIN)/python notebooks/execute.py --new
	$(BIN)/sphinx-build -W --keep-going --quiet -b html -c docs . build/docs
	$(BIN)/python -m pytest -m "" tests/test_site.py

clean:
	rm -rf $(VENV) build dist outputs docs/api docs/thumbnails
