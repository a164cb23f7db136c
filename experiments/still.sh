#!/usr/bin/env bash
# Decoders of trousers and dresses that learned on, also on people who stand almost still: their
# datasets, the packaged `nano`, `small` and `base`, and the table of docs/networks.md. About three
# hours on two cores.
set -euo pipefail
cd "$(dirname "$0")/.."
sets=(dress dress_mixed dress_left_out dresses dress_still dresses_still bottom bottoms bottom_still bottoms_still)
data=()
for name in "${sets[@]}"; do
  physxnet dataset build "experiments/datasets.toml#$name" --out "runs/clothes/$name"
  data+=(--data "runs/clothes/$name")
done
for name in nano small base; do
  physxnet train "experiments/training.toml#still-$name" --name "$name" --splits train extra "${data[@]}" --out "runs/still-$name"
done
python experiments/standing.py
