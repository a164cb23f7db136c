"""Options of the commands that measure and train, as dataclasses that tyro reads."""

import dataclasses
import pathlib
from typing import Annotated, Literal

import tyro


@dataclasses.dataclass(frozen=True)
class Stress:
    """Run the simulator's hard cases: what is measured, its bound, whether it holds.

    Examples:
      physxnet stress
      physxnet stress --cases free_fall scrambled_start -o stress.json
      physxnet stress --peers blender newton
    """

    cases: tuple[str, ...] = ()
    """Names of cases; all of them if none is given."""
    peers: tuple[Literal["blender", "newton"], ...] = ()
    """Other simulators that run the cases they can (PHYSXNET_BLENDER, PHYSXNET_NEWTON)."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write the rows to this file, as JSON."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Bench:
    """What accuracy costs in time: solvers and settings, or networks and their sizes.

    Examples:
      physxnet bench net --weights nano small local --data runs/ours --out out/net.json
      physxnet bench sim --out out/sim_bench.json
      physxnet bench sim --scenes sheet
      physxnet bench sim --blender 5 10 15 20 --shirt shirt.obj --motion punch.bvh
      physxnet bench sim --newton 5 10 20
    """

    what: tyro.conf.Positional[Literal["sim", "net"]]
    """sim: the simulator. net: networks beside skinning and the simulator."""
    weights: tuple[str, ...] = ("local",)
    """net: names or folders of weights, or runs."""
    data: pathlib.Path | None = None
    """net: a dataset whose test actions give the errors; times alone without one."""
    errors: pathlib.Path | None = None
    """net: rows of `physxnet evaluate` against that dataset; what is there isn't measured again,
    and rows of --out take their errors from it."""
    simulator: tuple[Literal["draft", "standard", "fine", "noise", "blender", "newton"], ...] = ()
    """net: accuracies of the simulator to run as well; noise is standard with jitter.
    blender, newton: their times alone, for they model another cloth."""
    precisions: tuple[Literal["float32", "bfloat16"], ...] = ("float32",)
    """net: what the networks' arithmetic is done in."""
    backward: bool = False
    """net: measure gradients as well."""
    times: bool = False
    """net: measure the times of these methods' rows again, and nothing else."""
    batches: tuple[int, ...] = (1, 32)
    """net: frames a call."""
    garments: tuple[int, ...] = (1, 2, 3)
    """net: how many garments are worn."""
    scenes: tuple[Literal["sheet", "skirt", "shirt"], ...] = ("sheet", "skirt", "shirt")
    """A hanging sheet, a dress on a spin, a shirt on a punch."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Rows as JSON, with a table (.md) and a diagram (.png) beside it; goes on from there."""
    frames: int = 20
    """Frames of the scenes with a body."""
    shirt: pathlib.Path | None = None
    """An OBJ file instead of the template top."""
    motion: str = "punch"
    """What the person in the shirt does: a motion file or a built-in clip."""
    blender: tuple[int, ...] = ()
    """Qualities at which Blender runs too, the finest last."""
    newton: tuple[int, ...] = ()
    """Substeps at which Newton runs too, likewise."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Build a dataset of simulated clothes from motion files, or look it over.

    Stopped, the same command goes on where it was; shards may run side by side.

    Examples:
      physxnet dataset build experiments/configs/dataset_physxnet.py --out runs/ours
      physxnet dataset build experiments/configs/dataset_blender.py --out runs/b --shard 1/4
      physxnet dataset check runs/ours --sheet out/ours.png
    """

    what: tyro.conf.Positional[Literal["build", "check"]]
    """build: simulate. check: look for explosions, penetration, jitter, wrong counts."""
    target: tyro.conf.Positional[str]
    """build: a configuration, a Python file with CONFIG. check: a dataset's folder."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """build: the dataset's folder."""
    mocap: pathlib.Path | None = None
    """Where ACTIONS.csv and the motion files lie; mocap in $PHYSXNET_DATA or ../shared.
    docs/protocol.md tells what is in it."""
    shard: str = "0/1"
    """build: i/n, every n-th action from the i-th."""
    only: tuple[str, ...] = ()
    """build: names of actions."""
    sheet: pathlib.Path | None = None
    """check: a contact sheet, .png."""
    json: bool = False
    """Print JSON: of check all findings instead of those out of bounds as a table, of build
    its checksum, size and time."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a network on a dataset.

    Stopped, the same command goes on where it was.

    Examples:
      physxnet train experiments/configs/local_cpu.py --data runs/ours --out runs/local
    """

    config: tyro.conf.Positional[str]
    """A Python file with CONFIG, a TrainConfig."""
    data: tyro.conf.UseAppendAction[tuple[pathlib.Path, ...]]
    """Folders of datasets."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """The run's folder: checkpoints, metrics.jsonl, TensorBoard events, weights."""
    splits: tuple[str, ...] = ("train",)
    """Parts of the datasets that are learned from."""
    steps: int | None = None
    """Stop after this many steps in all."""
    name: str | None = None
    """Name of the weights; the configuration's file name."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """The error of methods on every action of a dataset, beside what each costs.

    Methods: lbs, nearest, mlp, draft, standard, fine, noise, names of weights, folders of
    weights or of runs; blender and newton, which model another cloth. With +push after a
    network's name its vertices are pushed out of the body.

    Examples:
      physxnet evaluate local local+push lbs --data runs/ours --out out/errors.json
      physxnet evaluate lbs nearest mlp draft noise --data runs/ours --split test
    """

    methods: tyro.conf.Positional[tuple[str, ...]]
    """What is measured."""
    data: pathlib.Path
    """A dataset's folder: what is measured against."""
    split: str = "test"
    """train, test or extra."""
    learn_from: pathlib.Path | None = None
    """Dataset that nearest and mlp learn from; the same one."""
    templates: tuple[Literal["top", "bottom", "dress"], ...] = ("top", "bottom", "dress")
    """Garments."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Rows as JSON; tables (.md) and two charts (_vertices.png, _texels.png) beside it.
    Rows that are there already are kept."""
    times: bool = False
    """Measure the times of these methods' rows again, in one go, and nothing else."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""
