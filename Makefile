# From a fresh checkout, make demo trains a scene, and make test runs the tests.
VENV ?= .venv
DEMO ?= demo
DEMO_SECONDS ?= 120
RUN := $(DEMO)/runs/scene/ebarf/run
BIN := $(VENV)/bin
export PATH := $(abspath $(BIN)):$(PATH)

.PHONY: setup check test test-slow demo

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt tools/setup.sh
	sh tools/setup.sh $(VENV)
	touch $@

check: setup
	ruff check .
	ruff format --check .
	pyright --pythonpath $(abspath $(BIN)/python)

# Two workers; tests of one file stay together because they share scenes and runs. A hanging test fails.
test: check
	pytest -m "not slow and not gpu" -n 2 --dist loadscope --durations=10 --timeout=600

test-slow: check
	pytest -m "slow"

demo: setup
	rm -rf $(DEMO)/scene $(DEMO)/runs
	ebarf simulate $(DEMO)/scene
	ebarf inspect $(DEMO)/scene
	ebarf train $(DEMO)/scene --output-dir $(DEMO)/runs --experiment-name scene --timestamp run \
		--max-train-seconds $(DEMO_SECONDS) --vis tensorboard --logging.local-writer.enable False
	ebarf evaluate $(RUN)
	@echo
	@echo "report with plots     $(RUN)/report/report.html"
	@echo "renders, references   $(RUN)/renders/"
	@echo "refined trajectory    $(RUN)/trajectory_refined.txt"
	@echo "viewer                $(BIN)/ns-viewer --load-config $(RUN)/config.yml"
