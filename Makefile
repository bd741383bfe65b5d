# make train: set up what is missing, train the light-field network for minutes, show what it learned.
# make test:  set up what is missing, run the fast tests.     make test-all: the slow ones too.

PYTHON ?= python3
PY := .venv/bin/python
READY := .venv/ready
LPIPS := .cache/lpips/alex.safetensors

.PHONY: train test test-all lint clean
train: $(READY) $(LPIPS)
	$(PY) -m src.train experiment=lf3x3

test: $(READY) $(LPIPS)
	OMP_NUM_THREADS=1 $(PY) -m pytest -q -n 2 -m "not slow and not gpu"

test-all: $(READY) $(LPIPS)
	$(PY) -m pytest -q

lint: $(READY)
	$(PY) -m ruff check . && $(PY) -m ruff format --check .

# The environment is complete when this file is there; a changed pyproject.toml makes it anew.
$(READY): pyproject.toml constraints.txt scripts/setup.sh
	PYTHON=$(PYTHON) bash scripts/setup.sh
	touch $@

$(LPIPS):
	$(PY) -m scripts.fetch_lpips_backbone

clean:
	rm -rf .venv .cache out
