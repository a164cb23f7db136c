#!/usr/bin/env bash
# Every dataset and network of docs/reproduction.md, which lists the same commands and tells
# which tables are kept results without one.
# With the environment of `make` on the path (PATH=.venv/bin:$PATH), motion files at hand
# (PHYSXNET_DATA) and Blender (PHYSXNET_BLENDER). Most commands go on where they were stopped.
set -euo pipefail
cd "$(dirname "$0")/.."
physxnet dataset build experiments/datasets.toml#ours --out runs/ours
physxnet dataset build experiments/datasets.toml#extra --out runs/extra
physxnet dataset build experiments/datasets.toml#mixed --out runs/mixed
physxnet dataset build experiments/datasets.toml#mixed_extra --out runs/mixed_extra
physxnet dataset build experiments/datasets.toml#left_out --out runs/left_out
physxnet dataset build experiments/datasets.toml#mixed_left_out --out runs/mixed_left_out
physxnet dataset build experiments/datasets.toml#varied --out runs/varied
physxnet dataset build experiments/datasets.toml#wide --out runs/wide
physxnet dataset build experiments/datasets.toml#swift --out runs/swift
physxnet dataset build experiments/datasets.toml#varied_left_out --out runs/varied_left_out
physxnet dataset build experiments/datasets.toml#slow --out runs/slow
physxnet train experiments/training.toml#local --name local --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --splits train extra --out runs/local
physxnet train experiments/training.toml#local-muon --name local-muon --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --splits train extra --out runs/local-muon
physxnet train experiments/training.toml#small --name small --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --splits train extra --out runs/small
physxnet train experiments/training.toml#nano --name nano --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --splits train extra --out runs/nano
physxnet train experiments/training.toml#local-22 --name local-22 --data runs/ours --out runs/local-22
physxnet train experiments/training.toml#paper --name paper --data runs/ours --out runs/paper
physxnet train experiments/training.toml#local --name local-wide --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --data runs/wide --data runs/swift --data runs/varied_left_out --splits train extra --out runs/local-wide
physxnet dataset build experiments/datasets.toml#taught_a --out runs/taught_a
physxnet dataset build experiments/datasets.toml#taught_b --out runs/taught_b
physxnet train experiments/training.toml#local-taught --name local-taught --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --data runs/taught_a --data runs/taught_b --splits train extra --out runs/local-taught
physxnet evaluate runs/local-wide runs/local-wide+mirror runs/local-taught runs/local-taught+mirror --data runs/ours --train-data runs/ours --out experiments/results/more_motion.json
physxnet train experiments/training.toml#paper-25 --name paper-25 --data runs/ours --out runs/paper-25
physxnet evaluate lbs paper paper+push runs/paper-25 runs/paper-25+push --data runs/ours --out experiments/results/paper_longer.json
physxnet dataset build experiments/datasets.toml#blender --out runs/blender
physxnet dataset build experiments/datasets.toml#blender_extra --out runs/blender_extra
physxnet train experiments/training.toml#local-22 --name blender-22 --data runs/blender --out runs/blender-22
physxnet train experiments/training.toml#paper --name paper-blender --data runs/blender --out runs/paper-blender
python experiments/ablations.py
python experiments/unseen.py
python experiments/reproduce.py --data runs/blender --train-data runs/blender --methods lbs nearest mlp runs/blender-22 runs/blender-22+push runs/local-22 nano small local local+push pair+mirror paper paper+push runs/paper-blender draft standard
python experiments/reproduce.py --data runs/ours
