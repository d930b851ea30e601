PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: help setup demo test check clean
help:
	@echo "make demo    track three arms; pictures and replays land in out/"
	@echo "make test    the test suite"
	@echo "make check   ruff, mypy and the architecture test"
	@echo "make clean   remove .venv and out/"

setup: $(READY)
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,xacro]'
	touch $(READY)

demo: $(READY)
	$(BIN)/python demos/three_arms.py

test: $(READY)
	$(BIN)/python -m pytest

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest tests/test_architecture.py

clean:
	rm -rf .venv out
