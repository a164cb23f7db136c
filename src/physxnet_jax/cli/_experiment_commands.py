"""Options of the commands that measure and train, as dataclasses that tyro reads."""

import dataclasses
import pathlib
from typing import Annotated, Literal

import tyro

from ._options import QuietTerminal, RayAddress, Terminal


@dataclasses.dataclass(frozen=True)
class Stress:
    """Run the simulator's hard cases and check each measurement against its bound.

    Examples:
      physxnet stress
      physxnet stress --cases free_fall scrambled_start -o stress.json
      physxnet stress --peers blender newton
    """

    cases: tuple[str, ...] = ()
    """Names of cases; all by default."""
    peers: tuple[Literal["blender", "newton"], ...] = ()
    """Other simulators that run the cases they can (PHYSXNET_BLENDER, PHYSXNET_NEWTON)."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write the rows to this file, as JSON."""
    ray: RayAddress = None
    """Run the cases on a Ray cluster: its address, or none for one on this machine."""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure accuracy against time of solvers and settings, or of networks.

    Examples:
      physxnet bench net --weights nano small base --data runs/ours --out out/net.json
      physxnet bench sim --out out/sim_bench.json
      physxnet bench sim --scenes sheet
      physxnet bench sim --blender 5 10 15 20 --shirt shirt.obj --motion punch.bvh
      physxnet bench sim --newton 5 10 20
    """

    what: tyro.conf.Positional[Literal["sim", "net"]]
    """sim: the simulator. net: networks beside skinning and the simulator."""
    weights: tuple[str, ...] = ("base",)
    """net: names or folders of weights, or runs."""
    data: pathlib.Path | None = None
    """net: a dataset whose test actions give the errors; without one, only times are measured."""
    errors: pathlib.Path | None = None
    """net: rows of `physxnet evaluate` against that dataset; their errors aren't measured again,
    and replace those of rows in --out."""
    simulator: tuple[
        Literal["draft", "standard", "fine", "reference", "perturbed", "blender", "newton"], ...
    ] = ()
    """net: accuracies of the simulator to run as well; perturbed is standard with a perturbed
    root. blender, newton: times only, because they model another cloth."""
    precisions: tuple[Literal["float32", "bfloat16"], ...] = ("float32",)
    """net: precisions of the networks' arithmetic."""
    backward: bool = False
    """net: measure gradients as well."""
    times: bool = False
    """net: only measure the times of these methods' rows again."""
    batches: tuple[int, ...] = (1, 32)
    """net: frames per call."""
    garments: tuple[int, ...] = (1, 2, 3)
    """net: numbers of garments."""
    scenes: tuple[Literal["sheet", "skirt", "shirt"], ...] = ("sheet", "skirt", "shirt")
    """sim: a hanging sheet, a dress on a spin, a shirt on a punch."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Rows as JSON, with a table (.md) and a diagram (.png) next to it; existing rows are kept."""
    frames: int = 20
    """sim: frames of the scenes with a body."""
    shirt: pathlib.Path | None = None
    """sim: an OBJ file instead of the template top."""
    motion: str = "punch"
    """sim: the motion of scene shirt, a motion file or a built-in clip."""
    blender: tuple[int, ...] = ()
    """sim: quality settings to run Blender with as well, the finest last."""
    newton: tuple[int, ...] = ()
    """sim: substeps to run Newton with as well, the finest last."""
    terminal: QuietTerminal = dataclasses.field(default_factory=QuietTerminal)


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Build a dataset of simulated clothes from motion files, or check one.

    An interrupted build resumes if the same command is run again. With --ray, jobs of one garment
    on one group of actions run on all cores of a machine or cluster; shards are for queues without
    Ray. Every way stores the same bytes.

    Examples:
      physxnet dataset build experiments/datasets.toml#ours --out runs/ours
      physxnet dataset build experiments/datasets.toml#ours --out runs/ours --ray
      physxnet dataset build experiments/datasets.toml#blender --out runs/b --shard 1/4
      physxnet dataset check runs/ours --contact-sheet out/ours.png
    """

    what: tyro.conf.Positional[Literal["build", "check", "template"]]
    """build: simulate. check: look for explosions, penetration, jitter, wrong counts. template:
    write ACTIONS.csv for a folder of motion files."""
    target: tyro.conf.Positional[str]
    """build: a configuration, FILE.toml or FILE.toml#TABLE. check: a dataset's folder. template:
    the folder of motion files."""
    out: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """build: the dataset's folder, or a URL that tensorstore takes (s3://, gs://)."""
    mocap: pathlib.Path | None = None
    """Folder of ACTIONS.csv and the motion files; by default mocap in $PHYSXNET_DATA or ../shared.
    docs/protocol.md describes its contents."""
    ray: RayAddress = None
    """build: use a Ray cluster: its address, or none for one on this machine. All its machines need
    to see --out and --mocap."""
    shard: str = "0/1"
    """build: i/n, the i-th of n equal parts of the jobs, counted from 0."""
    only: tuple[str, ...] = ()
    """build: names of the actions to build; all by default."""
    contact_sheet: pathlib.Path | None = None
    """check: a contact sheet, .png."""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a network on a dataset.

    An interrupted run resumes if the same command is run again, on any number of devices. Processes
    that Slurm or Open MPI start join by themselves; others are given each other's address.

    Examples:
      physxnet train experiments/training.toml#base --data runs/default --out runs/base
      physxnet train experiments/training.toml#base --data runs/default -o runs/a --devices 2
    """

    config: tyro.conf.Positional[str]
    """A TrainConfig: FILE.toml or FILE.toml#TABLE."""
    data: tyro.conf.UseAppendAction[tuple[str, ...]]
    """Folders or URLs of datasets."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """The run's folder: checkpoints, metrics.jsonl, TensorBoard events, weights."""
    splits: tuple[str, ...] = ("train",)
    """Splits of the datasets to train on."""
    validation: tuple[str, ...] | None = None
    """Names of actions that are held out for validation, in place of the configuration's."""
    steps: int | None = None
    """Stop after this many steps in total."""
    devices: int | None = None
    """Devices of this machine to split batches among; by default as many as divide them."""
    coordinator: str | None = None
    """Address of the first of several processes, HOST:PORT."""
    num_processes: int | None = None
    """Number of processes."""
    process_id: int | None = None
    """This process's number, from 0."""
    name: str | None = None
    """Name of the weights; by default the configuration's table or file name."""
    terminal: QuietTerminal = dataclasses.field(default_factory=QuietTerminal)


@dataclasses.dataclass(frozen=True)
class Adapt:
    """Fine-tune a network to one garment: by its physics, or by simulations of it.

    Other garments of the same template are predicted worse afterwards. An interrupted run resumes
    if the same command is run again.

    Examples:
      physxnet adapt my_coat.obj --fabric wool -o coat
      physxnet adapt my_skirt.obj --simulate --motions dance.bvh -o skirt
      physxnet dress dance.bvh --wear my_coat.obj:fabric=wool --weights coat -o dance.usdc
    """

    garment: tyro.conf.Positional[str]
    """A garment file, a tailored garment or a template, with options after a colon."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the weights."""
    fabric: str | None = None
    """Fabric, or a file of one, if the garment names none."""
    weights: str = "base"
    """Name or folder of the weights to start from."""
    simulate: bool = False
    """Simulate the garment on all motions, and learn from that as well."""
    motions: tuple[str, ...] = ()
    """Motions to learn from, beside the built-in clips."""
    held_out: str = "punch"
    """Motion by which the best network is chosen, and the gain measured."""
    frames: int | None = None
    """Use at most so many frames of each motion."""
    shape: tuple[str, ...] = ()
    """Shape parameters of the body, as name=value: gender=1 weight_up=0.5 …"""
    steps: int = 1000
    """Steps of the optimizer."""
    seed: int = 0
    """Seed of the frames' order."""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Measure the error and the cost of methods on every action of a dataset.

    Methods: lbs, nearest, mlp, draft, standard, fine, perturbed, names of weights, folders of
    weights or of runs; blender and newton, which model another cloth. After a network's name,
    +mirror averages with the mirrored pose, +relax limits strain and +push resolves collisions.

    Examples:
      physxnet evaluate base base+guided lbs --data runs/default --out out/errors.json
      physxnet evaluate lbs nearest mlp draft perturbed --data runs/ours --split test
    """

    methods: tyro.conf.Positional[tuple[str, ...]]
    """Methods to measure."""
    data: str
    """Folder or URL of the reference dataset."""
    split: str = "test"
    """train, test or extra."""
    train_data: str | None = None
    """Dataset that nearest and mlp learn from; --data by default."""
    templates: tuple[Literal["top", "bottom", "dress"], ...] = ("top", "bottom", "dress")
    """Garments to measure."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Rows as JSON, with tables (.md) and two charts (_vertices.png, _texels.png) next to it.
    Existing rows are kept."""
    times: bool = False
    """Only measure the times of these methods' rows again, in one run."""
    ray: RayAddress = None
    """Measure on a Ray cluster, an action a job: its address, or none for one on this machine.
    Its times are those of one core."""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)
