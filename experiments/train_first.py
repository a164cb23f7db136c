"""Trains the first shipped checkpoint, `first`, from nothing but the motion files.

Command: python experiments/train_first.py --data ../shared/mocap --out runs/first
Cost:    dataset 8 minutes on two cores, training about an hour on two cores.
Result:  runs/first/weights, which `src/physxnet_jax/io/weights/first` is a copy of;
         `python experiments/compare_methods.py` measures it.

Both stages go on where they stopped.
"""

import argparse
import pathlib

from rich.console import Console

from physxnet_jax.data import build_dataset, list_sequences, read_protocol, read_sequence
from physxnet_jax.io import save_predictor
from physxnet_jax.models import ModelConfig
from physxnet_jax.training import TrainConfig, train

CONFIG = TrainConfig(
    model=ModelConfig(family="local", resolution=128, width=16),
    epochs=12,
    batch=8,
    learning_rate=1e-3,
    schedule="cosine",
    seed=0,
)
CARD = {
    "licence": "MIT (weights); the motion they learned from is the CMU Graphics Lab database",
    "data": "22 training actions, 3,217 frames at 30 fps, simulated by physxnet_jax XPBD"
    " (32 substeps, 4 contact queries a frame); sequences whose cloth came off the body"
    " (deeper than 0.1 m in it) left out for that garment",
    "limits": "one body shape, one fabric, three garments; learned on a small network for an hour;"
    " fast turns and high kicks are under-represented because their simulations were left out",
    "acknowledgement": "The data used in this project was obtained from mocap.cs.cmu.edu. The"
    " database was created with funding from NSF EIA-0196217.",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=pathlib.Path, default=pathlib.Path("../shared/mocap"))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/first"))
    parser.add_argument("--shard", default="0/1", help="i/n: simulate every n-th action")
    parser.add_argument("--build-only", action="store_true")
    args = parser.parse_args()
    console = Console()
    shard, shards = (int(x) for x in args.shard.split("/"))
    actions = [a for a in read_protocol(args.data) if a.split in ("train", "test")]
    build_dataset(
        args.out / "dataset",
        args.data,
        actions[shard::shards],
        report=lambda text, k, n: console.print(f"[{k}/{n}] {text}"),
    )
    if args.build_only:
        return
    folders = list_sequences(args.out / "dataset", "train")
    predictor = train(
        CONFIG,
        [read_sequence(f) for f in folders],
        args.out,
        report=lambda k, n, m: console.print(f"step {k}/{n}  L1 {m['l1']:.4f}", m),
    )
    save_predictor(args.out / "weights", predictor, name="first", card=CARD)


if __name__ == "__main__":
    main()
