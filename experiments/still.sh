#!/usr/bin/env bash
# Decoders that learned on, also on people who stand almost still: first those of trousers and
# dresses, then those of tops. Their datasets, the packaged `nano`, `small` and `base`, and the table
# of docs/networks.md. About four hours on two cores.
set -euo pipefail
cd "$(dirname "$0")/.."
sets=(dress dress_mixed dress_left_out dresses dress_still dresses_still bottom bottoms bottom_still bottoms_still)
tops=(top tops top_still tops_still)
for name in "${sets[@]}" "${tops[@]}"; do
  physxnet dataset build "experiments/datasets.toml#$name" --out "runs/clothes/$name"
done
for name in nano small base; do
  physxnet train "experiments/training.toml#still-$name" --name "$name" --splits train extra "${sets[@]/#/--data=runs/clothes/}" --out "runs/still-$name"
  physxnet train "experiments/training.toml#tops-$name" --name "$name" --splits train extra "${tops[@]/#/--data=runs/clothes/}" --out "runs/tops-$name"
done
python experiments/standing.py
