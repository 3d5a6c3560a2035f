PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test lint slow clean

# The main job: Algorithm 1 on CartPole against Gymnasium's CartPole-v1 with hidden length and mass; and a diagnosis of
# recordings in which an effect is concealed (made by `bayessim conceal`).
demo: .venv/installed
	rm -rf runs/demo runs/demo-physics
	$(BIN)/bayessim online cartpole --truth length=0.5 mass=0.3 --rounds 20 --out runs/demo
	$(BIN)/bayessim diagnose docs/examples/pendulum --out runs/demo-physics
	@echo "What was hidden is in docs/examples/pendulum/sealed.json, which the diagnosis never reads:"
	@$(BIN)/python -c "import json; print(json.load(open('docs/examples/pendulum/sealed.json'))['effects'][0])"
	@echo "Open runs/demo/report.html and runs/demo-physics/report.html"

test: .venv/installed-test
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

slow: .venv/installed-test
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow

lint: .venv/installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

.venv/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/installed-test: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test,fetch,brax]"
	touch $@

clean:
	rm -rf .venv runs build *.egg-info
