#!/usr/bin/env bash
# The tables and the picture of docs/accuracy-cost.md, which lists the same commands. With the
# environment of `make` on the path (PATH=.venv/bin:$PATH), runs/clothes/default built. Goes
# on where it was stopped: remove the result first to measure all of it in one sitting.
set -euo pipefail
cd "$(dirname "$0")/.."
physxnet bench net --weights nano base base+guided paper --garments 1 3 --batches 1 --simulator perturbed --errors experiments/results/test_errors.json --data runs/clothes/default --out experiments/results/accuracy_cost.json
