#!/usr/bin/env bash
# The tables and the picture of docs/accuracy-cost.md, which lists the same commands. With the
# environment of `make` on the path (PATH=.venv/bin:$PATH), runs/ours built, and Blender
# (PHYSXNET_BLENDER). Goes on where it was stopped: remove the result first to measure all of
# it in one sitting.
set -euo pipefail
cd "$(dirname "$0")/.."
physxnet bench net --weights nano small local local+relax local+mirror pair pair+mirror paper --garments 1 3 --backward --simulator draft standard fine perturbed blender --errors experiments/results/test_errors.json --data runs/ours --out experiments/results/accuracy_cost.json
physxnet bench net --weights small --garments 2 --errors experiments/results/test_errors.json --data runs/ours --out experiments/results/accuracy_cost.json
physxnet bench net --weights small --garments 1 3 --precisions float32 bfloat16 --data runs/ours --out experiments/results/precision.json
