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
    """

    motion: tyro.conf.Positional[str]
    """A .amc, .bvh or .npz file, or a built-in clip (see `physxnet clips`)."""
    wear: tuple[str, ...] = ("top", "bottom")
    """Templates (top, bottom, dress) and OBJ files."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Result: .usdc, .usd, .usda, .pc2 (with OBJ) or .npz."""
    preview: pathlib.Path | None = None
    """Picture or video: .png, .gif or .mp4."""
    method: Literal["network", "lbs", "simulate"] = "network"
    """network (packaged weights), lbs (skinning alone) or simulate (the teacher)."""
    fps: float = 30.0
    """Frames a second of the result."""
    frames: int | None = None
    """Stop after this many frames."""
    source_fps: float | None = None
    """True rate of the motion file, where its header is wrong or silent."""
    skeleton: pathlib.Path | None = None
    """The ASF of an AMC file, if it doesn't lie beside it."""
    weights: str = "first"
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
    """Result: .usdc, .usd, .usda, .pc2 (with OBJ) or .npz."""
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
    """What accuracy costs in time: every solver and setting against a reference.

    Examples:
      physxnet bench sim --out out/sim_bench.json
      physxnet bench sim --scenes sheet
      physxnet bench sim --blender 5 10 15 20 --shirt shirt.obj --motion punch.bvh
      physxnet bench sim --newton 5 10 20
    """

    what: tyro.conf.Positional[Literal["sim"]]
    """sim: the simulator."""
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
