# Two commands matter: `make demo` and `make test`. Both set up .venv by themselves.
# `make test-release` runs the longer tests, which CI runs too; `make test-nightly` the longest.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
SRC := $(shell find src tests experiments -name '*.py' 2>/dev/null)

# Many processes load the same libraries: the first leaves them compiled.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo test test-release test-nightly check docs bom format clean

# More extras of pyproject.toml: `make test EXTRAS=cluster` also tests Ray.
EXTRAS ?=

# One environment serves all targets; uv.lock decides every version.
$(VENV)/.ready: pyproject.toml uv.lock
	@$(PYTHON) -c "import sys; v = sys.version_info; sys.exit(0 if (3, 11) <= v[:2] < (3, 14) else f'physxnet_jax needs Python 3.11 to 3.13, $(PYTHON) is {v[0]}.{v[1]}: set PYTHON=python3.12, say')"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet "uv>=0.8"
	UV_PROJECT_ENVIRONMENT=$(abspath $(VENV)) $(BIN)/uv sync --quiet --frozen --inexact --python $(BIN)/python --extra usd --extra gltf --extra mesh --extra viewer --extra render --extra train --extra export --extra docs --extra dev $(EXTRAS:%=--extra %)
	@touch $@

demo: $(VENV)/.ready
	$(BIN)/physxnet demo --out out

test: $(VENV)/.ready
	$(BIN)/python -m pytest

test-release: $(VENV)/.ready
	$(BIN)/python -m pytest -m "release and not nightly"

# On this Python the longest tests; on the others the quick ones.
NIGHTLY_PYTHONS ?= python3.12 python3.13
test-nightly: $(VENV)/.ready
	PHYSXNET_RECORD=experiments/results $(BIN)/python -m pytest -m nightly
	for python in $(NIGHTLY_PYTHONS); do \
		$(MAKE) test PYTHON=$$python VENV=.venv-$$python || exit 1; \
	done

check: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports
	$(BIN)/python tests/check_words.py

docs: $(VENV)/.ready
	$(BIN)/python -m sphinx -W -q -b html docs docs/_build/html

# Bill of materials of the locked versions: CycloneDX 1.5.
bom: $(VENV)/.ready
	mkdir -p dist
	$(BIN)/uv export --frozen --quiet --format cyclonedx1.5 --extra usd --extra gltf --extra mesh --extra viewer --extra render --extra train --extra export --extra cluster --output-file dist/physxnet_jax.cdx.json >/dev/null

format: $(VENV)/.ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) out dist .pytest_cache
