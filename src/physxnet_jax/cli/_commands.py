"""The commands' options, as dataclasses that tyro reads."""

import dataclasses
import pathlib
from typing import Annotated, Literal

import tyro


@dataclasses.dataclass(frozen=True)
class Dress:
    """Dress a moving person.

    Examples:
      physxnet dress walk --wear top bottom -o walk.usdc
      physxnet dress 02_04.amc --wear dress --preview dress.mp4
      physxnet dress dance.bvh --wear my_shirt.obj bottom --method simulate -o out.pc2
      physxnet dress walk --wear dress --budget-ms 5 -o walk.usdc
    """

    motion: tyro.conf.Positional[str]
    """A .amc, .bvh or .npz file, or a built-in clip (see `physxnet clips`)."""
    wear: tuple[str, ...] = ("top", "bottom")
    """Templates (top, bottom, dress) and OBJ files."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Result: .usdc, .usd, .usda, .pc2, .mdd (with OBJ), .glb, .html, .obj (one a frame), .npz."""
    preview: pathlib.Path | None = None
    """Picture or video: .png, .gif or .mp4."""
    method: Literal["network", "lbs", "simulate"] = "network"
    """network (packaged weights), lbs (skinning alone) or simulate (the teacher)."""
    accuracy: Literal["draft", "standard", "fine"] = "standard"
    """Of simulate."""
    budget_ms: float | None = None
    """Pick the method: the most accurate within this time a frame on this machine."""
    max_error_mm: float | None = None
    """Pick the method: the fastest within this error on the test actions."""
    fps: float = 30.0
    """Frames a second of the result."""
    frames: int | None = None
    """Stop after this many frames."""
    source_fps: float | None = None
    """True rate of the motion file, where its header is wrong or silent."""
    skeleton: pathlib.Path | None = None
    """The ASF of an AMC file, if it doesn't lie beside it."""
    weights: str = "local"
    """Name or folder of network weights."""
    shape: tuple[str, ...] = ()
    """Shape parameters, as name=value: gender=1 weight_up=0.5 …"""
    body: bool = True
    """Put the body into the result."""
    push_out: bool = True
    """Push vertices that end inside the body onto it."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Inspect:
    """Look at garment files: unit, axes, mesh, fit, binding; say what mends them.

    Examples:
      physxnet inspect my_shirt.obj
      physxnet inspect *.obj --json
    """

    files: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    """OBJ files."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Make a garment file wearable: on the body, welded, clean, oriented, out of the skin.

    Examples:
      physxnet fit my_shirt.obj -o my_shirt_fitted.obj
      physxnet fit scan.obj --like dress --edge-length 12 -o scan_fitted.obj
    """

    file: tyro.conf.Positional[pathlib.Path]
    """An OBJ file; it isn't changed."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """The OBJ to write: metres, Y up, on the body at rest."""
    like: Literal["top", "bottom", "dress"] | None = None
    """Scale and move it to where this template is, instead of guessing its unit."""
    edge_length: float | None = None
    """Split or decimate towards edges of this length [mm]."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Dress a built-in walk: writes demo.usdc, demo.mp4 and demo.png."""

    out: pathlib.Path = pathlib.Path("out")
    """Folder to write to."""
    frames: int | None = None
    """Stop after this many frames."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Print versions, devices and optional parts; refuse a jaxlib that miscomputes."""

    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Time every way to dress on this machine, once; --budget-ms chooses by it.

    Times are kept in $XDG_CACHE_HOME or ~/.cache. Stopped, it goes on where it was.

    Examples:
      physxnet calibrate
    """

    again: bool = False
    """Forget what was measured before."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Clips:
    """List the built-in clips, templates and weights."""

    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Stress:
    """Run the simulator's hard cases: what is measured, its bound, whether it holds.

    Examples:
      physxnet stress
      physxnet stress --cases free_fall scrambled_start --json stress.json
      physxnet stress --peers blender newton
    """

    cases: tuple[str, ...] = ()
    """Names of cases; all of them if none is given."""
    peers: tuple[Literal["blender", "newton"], ...] = ()
    """Other simulators that run the cases they can (PHYSXNET_BLENDER, PHYSXNET_NEWTON)."""
    json: pathlib.Path | None = None
    """Write the rows to this file."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Simulate a scene: a motion with garments, or a scene file (TOML).

    Stopped, the same command goes on where it was.

    Examples:
      physxnet simulate walk --wear bottom top -o walk.usdc
      physxnet simulate punch --wear top --fabric silk --wind 0 0 4 --preview punch.mp4
      physxnet simulate scene.toml -o scene.npz
    """

    scene: tyro.conf.Positional[str]
    """A scene file (.toml), a motion file, or a built-in clip."""
    wear: tuple[str, ...] = ("top", "bottom")
    """Templates (top, bottom, dress) and OBJ files; not with a scene file."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Result: .usdc, .usd, .usda, .pc2, .mdd (with OBJ), .glb, .html, .obj (one a frame), .npz."""
    preview: pathlib.Path | None = None
    """Picture or video: .png, .gif or .mp4."""
    accuracy: Literal["draft", "standard", "fine"] | None = None
    """What it may cost; standard, or what the scene file says."""
    fabric: str | None = None
    """cotton, denim, silk, wool, jersey or leather for all garments."""
    wind: tuple[float, float, float] | None = None
    """Steady wind [m/s]."""
    self_contact: bool = False
    """Garments collide with themselves."""
    fps: float = 30.0
    """Frames a second."""
    frames: int | None = None
    """Stop after this many frames."""
    engine: Literal["xpbd", "bdf2", "blender", "newton"] = "xpbd"
    """bdf2: implicit, second order. blender: out of process (see PHYSXNET_BLENDER).
    newton: likewise (PHYSXNET_NEWTON)."""
    body: bool = True
    """Put the body into the result."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Effects:
    """What a scene's effects cost and change: each is removed in turn and measured.

    Examples:
      physxnet effects walk --wear top --frames 20
      physxnet effects scene.toml --recommend --json effects.json
    """

    scene: tyro.conf.Positional[str]
    """A scene file (.toml), a motion file, or a built-in clip."""
    wear: tuple[str, ...] = ("top", "bottom")
    """Templates (top, bottom, dress) and OBJ files; not with a scene file."""
    frames: int | None = 20
    """Frames that are simulated."""
    recommend: bool = False
    """Say which effects matter, those that the scene doesn't have included."""
    tolerance: float = 2.0
    """Differences below this don't matter [mm]."""
    json: pathlib.Path | None = None
    """Write the rows to this file."""
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
    simulator: tuple[Literal["draft", "standard", "fine", "noise"], ...] = ()
    """net: accuracies of the simulator to run as well; noise is standard with jitter."""
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
    """Where ACTIONS.csv and the motion files lie; mocap in $PHYSXNET_DATA or ../shared."""
    shard: str = "0/1"
    """build: i/n, every n-th action from the i-th."""
    only: tuple[str, ...] = ()
    """build: names of actions."""
    sheet: pathlib.Path | None = None
    """check: a contact sheet, .png."""
    json: pathlib.Path | None = None
    """check: findings as JSON."""
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
class Export:
    """Write clothes as one function that needs no more than jax and flatbuffers.

    Examples:
      physxnet export --wear top bottom --out out/dresser
    """

    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the function (StableHLO), triangles, a card and a loader."""
    wear: tuple[str, ...] = ("top", "bottom")
    """Garments: OBJ files or top, bottom, dress."""
    weights: str = "local"
    """Name or folder of network weights."""
    fps: float = 30.0
    """Frames a second that it will be asked for."""
    push_out: bool = True
    """Push vertices that end inside the body onto it."""
    platforms: tuple[str, ...] = ("cpu", "cuda")
    """Where it will run."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """The error of methods on every action of a dataset, beside what each costs.

    Methods: lbs, nearest, mlp, draft, standard, fine, noise, names of weights, folders of
    weights or of runs. With +push after a network's name its vertices are pushed out of
    the body.

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
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""
