"""Options of what simulates, as dataclasses that tyro reads."""

import dataclasses
import pathlib
from typing import Annotated, Literal

import tyro


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
    """Templates (top, bottom, dress) and garment files; a scene file names its own."""
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
    source_fps: float | None = None
    """True rate of the motion file, where its header is wrong or silent."""
    skeleton: pathlib.Path | None = None
    """The ASF of an AMC file, if it doesn't lie beside it."""
    joint_map: pathlib.Path | None = None
    """Joint names of the motion file, for unknown ones: TOML lines like Hips = "pelvis"."""
    start: float = 0.0
    """Begin at this second of the motion."""
    frames: int | None = None
    """Stop after this many frames."""
    engine: Literal["xpbd", "bdf2", "blender", "newton"] = "xpbd"
    """bdf2: implicit, second order. blender: out of process (see PHYSXNET_BLENDER).
    newton: likewise (PHYSXNET_NEWTON)."""
    body: bool = True
    """Put the body into the result."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Effects:
    """What a scene's effects cost and change: each is removed in turn and measured.

    Examples:
      physxnet effects walk --wear top --frames 20
      physxnet effects scene.toml --recommend -o effects.json
    """

    scene: tyro.conf.Positional[str]
    """A scene file (.toml), a motion file, or a built-in clip."""
    wear: tuple[str, ...] = ("top", "bottom")
    """Templates (top, bottom, dress) and garment files; a scene file names its own."""
    frames: int | None = 20
    """Frames that are simulated."""
    source_fps: float | None = None
    """True rate of the motion file, where its header is wrong or silent."""
    skeleton: pathlib.Path | None = None
    """The ASF of an AMC file, if it doesn't lie beside it."""
    joint_map: pathlib.Path | None = None
    """Joint names of the motion file, for unknown ones: TOML lines like Hips = "pelvis"."""
    recommend: bool = False
    """Say which effects matter, those that the scene doesn't have included."""
    tolerance: float = 2.0
    """Differences below this don't matter [mm]."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write the rows to this file, as JSON."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""
