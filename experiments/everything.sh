#!/usr/bin/env bash
# Every dataset, network and number of docs/reproduction.md, which lists the same commands.
# With the environment of `make` on the path (PATH=.venv/bin:$PATH), motion files at hand
# (PHYSXNET_DATA) and Blender (PHYSXNET_BLENDER). Most commands go on where they were stopped.
set -euo pipefail
cd "$(dirname "$0")/.."
physxnet dataset build experiments/configs/dataset_physxnet.py --out runs/ours
physxnet dataset build experiments/configs/dataset_extra.py --out runs/extra
physxnet dataset build experiments/configs/dataset_mixed.py --out runs/mixed
physxnet dataset build experiments/configs/dataset_mixed_extra.py --out runs/mixed_extra
physxnet dataset build experiments/configs/dataset_left_out.py --out runs/left_out
physxnet dataset build experiments/configs/dataset_mixed_left_out.py --out runs/mixed_left_out
physxnet dataset build experiments/configs/dataset_varied.py --out runs/varied
physxnet dataset build experiments/configs/dataset_wide.py --out runs/wide
physxnet dataset build experiments/configs/dataset_swift.py --out runs/swift
physxnet dataset build experiments/configs/dataset_varied_left_out.py --out runs/varied_left_out
physxnet dataset build experiments/configs/dataset_slow.py --out runs/slow
physxnet train experiments/configs/local_cpu.py --name local --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --splits train extra --out runs/local
physxnet train experiments/configs/local_muon_cpu.py --name local-muon --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --splits train extra --out runs/local-muon
physxnet train experiments/configs/local_small_cpu.py --name small --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --splits train extra --out runs/small
physxnet train experiments/configs/local_nano_cpu.py --name nano --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --splits train extra --out runs/nano
physxnet train experiments/configs/local_22_cpu.py --name local-22 --data runs/ours --out runs/local-22
physxnet train experiments/configs/paper_cpu.py --name paper --data runs/ours --out runs/paper
physxnet train experiments/configs/local_cpu.py --name local-wide --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --data runs/wide --data runs/swift --data runs/varied_left_out --splits train extra --out runs/local-wide
physxnet dataset build experiments/configs/dataset_taught_a.py --out runs/taught_a
physxnet dataset build experiments/configs/dataset_taught_b.py --out runs/taught_b
physxnet train experiments/configs/local_taught_cpu.py --name local-taught --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied --data runs/taught_a --data runs/taught_b --splits train extra --out runs/local-taught
physxnet evaluate runs/local-wide runs/local-wide+mirror runs/local-taught runs/local-taught+mirror --data runs/ours --learn-from runs/ours --out experiments/results/more_motion.json
physxnet train experiments/configs/paper_25_cpu.py --name paper-25 --data runs/ours --out runs/paper-25
physxnet evaluate lbs paper paper+push runs/paper-25 runs/paper-25+push --data runs/ours --out experiments/results/paper_longer.json
physxnet dataset build experiments/configs/dataset_blender.py --out runs/blender
physxnet dataset build experiments/configs/dataset_blender_extra.py --out runs/blender_extra
physxnet train experiments/configs/local_22_cpu.py --name blender-22 --data runs/blender --out runs/blender-22
physxnet train experiments/configs/paper_cpu.py --name paper-blender --data runs/blender --out runs/paper-blender
python experiments/ablations.py
python experiments/previous_offset.py
python experiments/mirrored_answer.py
python experiments/cloth_memory.py
python experiments/clip_start.py
python experiments/unseen.py
python experiments/reproduce.py --data runs/blender --learn-from runs/blender --methods lbs nearest mlp runs/blender-22 runs/blender-22+push runs/local-22 nano small local local+push pair+mirror paper paper+push runs/paper-blender draft standard
python experiments/reproduce.py --data runs/ours
