#!/usr/bin/env bash
# Every dataset, network and table of docs/reproduction.md, which lists the same commands.
# With the environment of `make` on the path (PATH=.venv/bin:$PATH), motion files at hand
# (PHYSXNET_DATA) and Blender (PHYSXNET_BLENDER). Most commands go on where they were stopped.
set -euo pipefail
cd "$(dirname "$0")/.."
physxnet dataset build experiments/datasets.toml#ours --out runs/ours
physxnet dataset build experiments/datasets.toml#blender --out runs/blender
physxnet dataset build experiments/datasets.toml#default --out runs/clothes/default
physxnet dataset build experiments/datasets.toml#default_extra --out runs/clothes/default_extra
physxnet dataset build experiments/datasets.toml#default_mixed --out runs/clothes/default_mixed
physxnet dataset build experiments/datasets.toml#default_left_out --out runs/clothes/default_left_out
physxnet dataset build experiments/datasets.toml#variants --out runs/clothes/variants
physxnet train experiments/training.toml#base --name base --data runs/clothes/default --data runs/clothes/default_extra --data runs/clothes/default_mixed --data runs/clothes/default_left_out --data runs/clothes/variants --splits train extra --out runs/base
physxnet train experiments/training.toml#finish-base --name base --data runs/clothes/default --data runs/clothes/default_extra --data runs/clothes/default_mixed --data runs/clothes/default_left_out --data runs/clothes/variants --splits train extra --out runs/finish-base
bash experiments/still.sh
physxnet train experiments/training.toml#paper --name paper --data runs/ours --out runs/paper
physxnet train experiments/training.toml#paper --name paper-blender --data runs/blender --out runs/paper-blender
physxnet train experiments/training.toml#local-22 --name local-22 --data runs/ours --out runs/local-22
physxnet train experiments/training.toml#local-22 --name blender-22 --data runs/blender --out runs/blender-22
python experiments/reproduce.py --data runs/clothes/default
python experiments/reproduce.py --fitted --data runs/ours
python experiments/reproduce.py --fitted --data runs/blender --train-data runs/blender --methods lbs nearest mlp runs/local-22 runs/blender-22 runs/blender-22+push paper paper+push runs/paper-blender draft standard
