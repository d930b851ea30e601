PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: help setup demo demos test check docs docs-check pictures mutants fuzz fuzz-calls fuzz-files fuzz-descriptions random-arms campaign-kills monitor-campaign adaptive-campaign certificate-campaign adaptive-bound-campaign export-check faults hostile-samples bench-history clean
help:
	@echo "make demo           track three arms; pictures and replays land in out/"
	@echo "make demos          every demo in demos/, at its full length; some minutes"
	@echo "make test           the test suite"
	@echo "make check          ruff, mypy and the architecture test"
	@echo "make docs           the documentation as a site that works offline, in out/site"
	@echo "make docs-check     run every command and every line of Python of the how-tos; some minutes"
	@echo "make pictures       the pictures of README and docs again; half an hour, and Chromium"
	@echo "make mutants        how many of 60 seeded faults the tests find; about half an hour"
	@echo "make fuzz           the next three: every door of the package, broken at random; about half an hour"
	@echo "make fuzz-calls     10,000 calls with hostile arguments at every public function"
	@echo "make fuzz-files     10,000 damaged files at every reader; about five minutes"
	@echo "make fuzz-descriptions  20,000 broken URDF and xacro files and 5,000 in MJCF; about ten minutes"
	@echo "make random-arms    50 random arms with rotors and friction, untuned; about five minutes"
	@echo "make campaign-kills a campaign killed at 20 random moments, and its table; about two minutes"
	@echo "make monitor-campaign  false alarms of 200 honest runs, and whether faults are named; about 3 minutes"
	@echo "make adaptive-campaign  what the adaptive law keeps of its promises on four arms; about half an hour"
	@echo "make certificate-campaign  2,000 random certificates against MuJoCo; about two hours"
	@echo "make adaptive-bound-campaign  1,000 unknown loads against the bound of adaptive laws; about 20 minutes"
	@echo "make export-check   exported C under gcc, clang, sanitizers, qemu and frama-c, as far as they are here; about ten minutes"
	@echo "make faults         the fault matrix of docs/runtime.md, 5 trials a row; up to 20 minutes"
	@echo "make hostile-samples  ten million hostile samples through the guard; about 3 minutes"
	@echo "make bench-history  append this machine's figures to bench-history.jsonl; leave it alone meanwhile"
	@echo "make clean          remove .venv and out/"

setup: $(READY)
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[cluster,dev,docs,franka,logs,parquet,verify,xacro]'
	touch $(READY)

demo: $(READY)
	$(BIN)/python demos/three_arms.py

demos: $(READY)
	for demo in demos/*.py; do echo "$$demo"; $(BIN)/python "$$demo" || exit 1; done

test: $(READY)
	$(BIN)/python -m pytest

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest tests/test_architecture.py

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	$(BIN)/python tools/check_site.py out/site

docs-check: $(READY)
	$(BIN)/python -m pytest tests/test_docs.py -m pages --dist load

pictures: $(READY)
	$(BIN)/python tools/pictures.py

mutants: $(READY)
	$(BIN)/python tools/mutants.py

fuzz: fuzz-calls fuzz-files fuzz-descriptions

fuzz-calls: $(READY)
	$(BIN)/python tools/fuzz_api.py

fuzz-files: $(READY)
	$(BIN)/python tools/fuzz_files.py

fuzz-descriptions: $(READY)
	$(BIN)/python tools/fuzz_descriptions.py
	$(BIN)/python tools/fuzz_descriptions.py --format mjcf --count 5000

random-arms: $(READY)
	$(BIN)/python tools/random_arms.py

campaign-kills: $(READY)
	$(BIN)/python tools/campaign_kills.py

monitor-campaign: $(READY)
	$(BIN)/python tools/monitor_campaign.py

adaptive-campaign: $(READY)
	$(BIN)/python tools/adaptive_campaign.py

certificate-campaign: $(READY)
	$(BIN)/python tools/certificate_campaign.py

adaptive-bound-campaign: $(READY)
	$(BIN)/python tools/adaptive_bound_campaign.py

export-check: $(READY)
	$(BIN)/python tools/export_check.py

faults: $(READY)
	$(BIN)/nbs-pin faults

hostile-samples: $(READY)
	$(BIN)/python tools/hostile_samples.py

bench-history: $(READY)
	$(BIN)/python tools/bench_history.py

clean:
	rm -rf .venv out
