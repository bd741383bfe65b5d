# make:       set up what is missing.
# make train: set up what is missing, train the one-view network on nine views for minutes, show what it learned.
# make test:  set up what is missing, run the fast tests.     make test-all: the slow ones too.
# make demo:  set up what is missing, simulate a recording once, play it live in the browser.
# make docs:  the site of docs/ in out/site; REPO_URL=https://... where its links to code lead.

PYTHON ?= python3
PY := .venv/bin/python
READY := .venv/ready
LPIPS := .cache/lpips/alex.safetensors
DEMO := out/demo
SITE := .cache/docs

.PHONY: setup train test test-all demo docs lint clean
setup: $(READY) $(LPIPS)
	@echo "ready: .venv with all packages, and the network of LPIPS; next: source .venv/bin/activate"

train: $(READY) $(LPIPS)
	$(PY) -m src.train experiment=lf3x3 budget=fine_tuning

test: $(READY) $(LPIPS)
	OMP_NUM_THREADS=1 $(PY) -m pytest -q -n 2 --dist worksteal -m "not slow and not gpu"

test-all: $(READY) $(LPIPS)
	$(PY) -m pytest -q

demo: $(READY) $(DEMO)/cap.views.yaml
	$(PY) -m src.live recording=$(DEMO)/cap.raw views=$(DEMO)/cap.views.yaml ckpt=setnet_small \
		fps=600 playback_speed=0.2 threads=2 loop=true

docs: $(SITE)/ready
	NO_MKDOCS_2_WARNING=1 $(SITE)/bin/python -m mkdocs build --strict  # --quiet would hide warnings from it
	@echo "the site is in out/site"

lint: $(READY)
	$(PY) -m ruff check . && $(PY) -m ruff format --check . && $(PY) -m mypy

# The environment is complete when this file is there; a changed pyproject.toml makes it anew.
$(READY): pyproject.toml constraints.txt scripts/setup.sh
	PYTHON=$(PYTHON) bash scripts/setup.sh
	touch $@

# The site needs nothing of the project's own dependencies: the code is read, not imported.
$(SITE)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(SITE)
	$(SITE)/bin/python -c 'import tomllib; project = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
		print(*project["optional-dependencies"]["docs"], sep="\n")' > $(SITE)/requirements.txt
	$(SITE)/bin/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --requirement $(SITE)/requirements.txt
	touch $@

# The views are written last, when the recording beside them is whole.
$(DEMO)/cap.views.yaml: | $(READY)
	@echo "simulating a recording of nine views, once"
	$(PY) -m src.simulate --config-name demo write=$(DEMO)/cap.raw

$(LPIPS):
	$(PY) -m scripts.fetch_lpips_backbone

clean:
	rm -rf .venv .cache out
