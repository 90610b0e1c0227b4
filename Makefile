# make demo: from nothing to a trained scene. make test: from nothing to green tests.
VENV ?= .venv
DEMO_SECONDS ?= 120
BIN := $(VENV)/bin
export PATH := $(abspath $(BIN)):$(PATH)

.PHONY: setup check test test-slow demo

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml tools/setup.sh
	sh tools/setup.sh $(VENV)
	touch $@

check: setup
	ruff check .
	ruff format --check .
	pyright --pythonpath $(abspath $(BIN)/python)

test: check
	pytest -m "not slow and not gpu" --durations=10

test-slow: check
	pytest -m "slow"

demo: setup
	rm -rf demo/runs
	ebarf simulate demo/scene
	ebarf inspect demo/scene
	ns-train ebarf --data demo/scene --output-dir demo/runs --experiment-name scene --timestamp run \
		--max-train-seconds $(DEMO_SECONDS) --vis tensorboard --logging.local-writer.enable False
	ns-eval --load-config demo/runs/scene/ebarf/run/config.yml --output-path demo/runs/evaluation.json
	ebarf evaluate demo/runs/scene/ebarf/run
	@echo
	@echo "report with plots   demo/runs/scene/ebarf/run/report/report.html"
	@echo "renders, references demo/runs/scene/ebarf/run/renders/"
	@echo "refined trajectory  demo/runs/scene/ebarf/run/trajectory_refined.txt"
	@echo "viewer              $(BIN)/ns-viewer --load-config demo/runs/scene/ebarf/run/config.yml"
