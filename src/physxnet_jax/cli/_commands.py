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
      physxnet dress my_dancer.glb --own-body --wear top bottom -o dancer.usdc
      physxnet dress dance.bvh --character my_avatar.vrm --wear dress -o avatar.glb
    """

    motion: tyro.conf.Positional[str]
    """A .bvh, .amc, .glb, .gltf, .vrma or .npz file, or a built-in clip (see `physxnet clips`)."""
    wear: tuple[str, ...] = ("top", "bottom")
    """Templates (top, bottom, dress) and files (.obj, .glb, .gltf, .usd*, .ply, .stl; coat.obj=top
    says what one is dressed as): tops over dresses over trousers, of two of one kind the second
    over the first."""
    own_body: bool = False
    """The file is a person of your own to be dressed: .glb, .usd, .pc2, .mdd (with OBJ), .npz."""
    character: pathlib.Path | None = None
    """A rigged person of your own (.glb, .gltf, .vrm), whom the motion moves."""
    character_map: pathlib.Path | None = None
    """Joint names of --character, for unknown ones: TOML lines like Hips = "pelvis"."""
    body_mesh: str | None = None
    """Of --own-body and --character: name of the body's mesh, in a file of several."""
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
    start: float = 0.0
    """Begin at this second of the motion."""
    frames: int | None = None
    """Stop after this many frames."""
    source_fps: float | None = None
    """True rate of the motion file, where its header is wrong or silent."""
    skeleton: pathlib.Path | None = None
    """The ASF of an AMC file, if it doesn't lie beside it."""
    joint_map: pathlib.Path | None = None
    """Joint names of the motion file, for unknown ones: TOML lines like Hips = "pelvis"."""
    weights: str = "local+relax"
    """Name or folder of network weights; with +mirror the mirrored person is asked too, with
    +relax the cloth's edges are brought back to their lengths."""
    shape: tuple[str, ...] = ()
    """Shape parameters, as name=value: gender=1 weight_up=0.5 …"""
    body: bool = True
    """Put the body into the result."""
    push_out: bool = True
    """Push vertices that end inside the body onto it."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Inspect:
    """Look at garment or motion files: what they are, what is wrong, what mends it.

    Examples:
      physxnet inspect my_shirt.obj
      physxnet inspect coat.glb coat.glb#sleeves --json
      physxnet inspect dance.bvh walk.amc
    """

    files: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    """Garments (.obj, .glb, .gltf, .usd, .usda, .usdc, .ply, .stl; coat.glb#sleeves is one mesh of
    several) or motions (.bvh, .amc, .npz, .vrma, .glb and .gltf without a mesh, built-in clips)."""
    motion: bool = False
    """Of a .glb or .gltf that has both look at the animation."""
    source_fps: float | None = None
    """True rate of the motion files, where their headers are wrong."""
    skeleton: pathlib.Path | None = None
    """The ASF of AMC files."""
    joint_map: pathlib.Path | None = None
    """Joint names of the motion files, for unknown ones: TOML lines like Hips = "pelvis"."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Make a garment file wearable: on the body, welded, clean, oriented, out of the skin.

    Examples:
      physxnet fit my_shirt.obj -o my_shirt_fitted.obj
      physxnet fit scan.obj --like dress --decimate 12 -o scan_fitted.obj
      physxnet fit tank_top.glb --drape -o tank_top_fitted.obj
    """

    file: tyro.conf.Positional[pathlib.Path]
    """A garment, as `physxnet inspect` reads it; it isn't changed."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """The OBJ to write: metres, Y up, on the body at rest."""
    like: Literal["top", "bottom", "dress"] | None = None
    """Turn, scale and move it to where this template is, instead of guessing its unit."""
    edge_length: float | None = None
    """Split edges that are longer than this [mm]."""
    decimate: float | None = None
    """Before that, make it coarser: edges of about this length [mm]."""
    drape: bool = False
    """At last let it down onto the body by its weight: for straps that hang in the air."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Rest:
    """Write the body at rest, and templates on it, as OBJ: to model garments on.

    Metres, Y up, origin in the pelvis, arms 45 degrees down. A garment modelled on the
    default shape follows the others; --shape shows what they look like.

    Examples:
      physxnet rest -o rest
      physxnet rest --wear top dress -o rest
    """

    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for body.obj and a file for each template."""
    wear: tuple[Literal["top", "bottom", "dress"], ...] = ("top", "bottom", "dress")
    """Templates to write beside it, as a body of that shape wears them."""
    shape: tuple[str, ...] = ()
    """Shape parameters, as name=value: gender=1 weight_up=0.5 …"""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Dress a built-in walk: writes demo.usdc, demo.mp4 and demo.png.

    Examples:
      physxnet demo --out out
    """

    out: pathlib.Path = pathlib.Path("out")
    """Folder to write to."""
    frames: int | None = None
    """Stop after this many frames."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Print versions, devices and optional parts; refuse a jaxlib that miscomputes.

    Examples:
      physxnet doctor
      physxnet doctor --json
    """

    json: bool = False
    """Print JSON for machines instead of tables."""
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
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class Clips:
    """List the built-in clips, templates and weights.

    Examples:
      physxnet clips
      physxnet clips --json
    """

    json: bool = False
    """Print JSON for machines instead of tables."""
    debug: bool = False
    """Show the trace of an error."""


@dataclasses.dataclass(frozen=True)
class View:
    """Open the viewer in a browser: motions, garments, methods, shapes, errors, maps.

    It listens on this machine alone. Over ssh, forward its port:
    ssh -L 8080:localhost:8080 machine

    Examples:
      physxnet view
      physxnet view dance.bvh --wear my_shirt.obj bottom
      physxnet view walk --wear dress --html walk.html
      physxnet view punch --wear top --method simulate --wind 0 0 4 --fabric silk
    """

    motion: tyro.conf.Positional[str] = "walk"
    """A .bvh, .amc, .glb, .gltf or .npz file, or a built-in clip (see `physxnet clips`)."""
    wear: tuple[str, ...] = ("top", "bottom")
    """Templates (top, bottom, dress) and garment files."""
    method: Literal["network", "lbs", "simulate"] = "network"
    """network, lbs (skinning alone) or simulate."""
    weights: str = "local+relax"
    """Name of network weights, as for dress."""
    compare: bool = False
    """Simulate the same clothes beside it and colour by the distance."""
    live: bool = False
    """Ask the network for each frame in the moment it is shown, and tell what that takes."""
    push_out: bool = True
    """Push vertices that end inside the body onto it."""
    shape: tuple[str, ...] = ()
    """Shape parameters, as name=value: gender=1 weight_up=0.5 …"""
    accuracy: Literal["draft", "standard", "fine"] = "standard"
    """What a simulation may cost."""
    fabric: str | None = None
    """cotton, denim, silk, wool, jersey or leather for all garments when simulated."""
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Steady wind when simulated [m/s]."""
    self_contact: bool = False
    """Garments collide with themselves when simulated."""
    frames: int = 150
    """Frames at most."""
    fps: float = 30.0
    """Frames a second."""
    source_fps: float | None = None
    """True rate of the motion file, where its header is wrong or silent."""
    skeleton: pathlib.Path | None = None
    """The ASF of an AMC file, if it doesn't lie beside it."""
    joint_map: pathlib.Path | None = None
    """Joint names of the motion file, for unknown ones: TOML lines like Hips = "pelvis"."""
    html: pathlib.Path | None = None
    """Write one page that plays by itself, and end."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 lets every machine of the network in."""
    port: int = 8080
    """Port to listen at; the next free one is taken."""
    browser: bool = True
    """Open the browser."""
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
    """Garments: files or top, bottom, dress."""
    weights: str = "local+relax"
    """Name or folder of network weights, as for dress."""
    fps: float = 30.0
    """Frames a second that it will be asked for."""
    push_out: bool = True
    """Push vertices that end inside the body onto it."""
    platforms: tuple[str, ...] = ("cpu", "cuda")
    """Where it will run."""
    json: bool = False
    """Print JSON for machines instead of tables."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Show the trace of an error."""
