"""The commands' options, as dataclasses that tyro reads."""

import dataclasses
import pathlib
from typing import Annotated, Literal

import tyro

from ._options import (
    BodyOptions,
    EffectOptions,
    InferenceOptions,
    JsonTerminal,
    MotionSource,
    Outfit,
    Output,
    PreviewOptions,
    QuietTerminal,
    SimulationOptions,
    Terminal,
)


@dataclasses.dataclass(frozen=True)
class Dress:
    """Dress a moving person.

    Examples:
      physxnet dress walk --wear top bottom -o walk.usdc
      physxnet dress 02_04.amc --wear dress --preview dress.mp4
      physxnet dress dance.bvh --wear coat.obj:as=top,fabric=wool bottom --method simulate -o o.pc2
      physxnet dress walk --wear dress --budget-ms 5 -o walk.usdc
      physxnet dress my_dancer.glb --animated-body --wear top bottom -o dancer.usdc
      physxnet dress dance.bvh --character my_avatar.vrm --wear dress -o avatar.glb
    """

    motion: tyro.conf.Positional[str]
    """A .bvh, .amc, .glb, .gltf, .vrma, .npz or .pkl file, or a clip of `physxnet clips`."""
    method: Literal["guided", "network", "lbs", "simulate"] = "guided"
    """guided (a network, and a few substeps of simulation drawn to it), network (without those),
    lbs (skinning alone) or simulate (the teacher)."""
    budget_ms: float | None = None
    """Select the most accurate method within this time per frame on this machine [ms]."""
    max_error_mm: float | None = None
    """Select the fastest method within this error on the test actions [mm]."""
    source: MotionSource = dataclasses.field(default_factory=MotionSource)
    outfit: Outfit = dataclasses.field(default_factory=Outfit)
    person: BodyOptions = dataclasses.field(default_factory=BodyOptions)
    inference: InferenceOptions = dataclasses.field(default_factory=InferenceOptions)
    simulation: SimulationOptions = dataclasses.field(default_factory=SimulationOptions)
    output: Output = dataclasses.field(default_factory=Output)
    picture: PreviewOptions = dataclasses.field(default_factory=PreviewOptions)
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Simulate a scene: a motion with garments, or a scene file (TOML).

    With -o or --preview, an interrupted run of xpbd or bdf2 resumes where it stopped.

    Examples:
      physxnet simulate walk --wear bottom top -o walk.usdc
      physxnet simulate punch --wear top:fabric=silk --wind 0 0 4 --preview punch.mp4
      physxnet simulate scene.toml -o scene.npz
    """

    scene: tyro.conf.Positional[str]
    """A scene file (.toml), a motion file, or a built-in clip."""
    source: MotionSource = dataclasses.field(default_factory=MotionSource)
    outfit: Outfit = dataclasses.field(default_factory=Outfit)
    person: BodyOptions = dataclasses.field(default_factory=BodyOptions)
    simulation: SimulationOptions = dataclasses.field(default_factory=SimulationOptions)
    output: Output = dataclasses.field(default_factory=Output)
    picture: PreviewOptions = dataclasses.field(default_factory=PreviewOptions)
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Effects:
    """Measure what each effect of a scene costs and changes, by removing it.

    Examples:
      physxnet effects walk --wear top --frames 20
      physxnet effects scene.toml --recommend --write-scene needed.toml
    """

    scene: tyro.conf.Positional[str]
    """A scene file (.toml), a motion file, or a built-in clip."""
    recommend: bool = False
    """Report which effects matter, including those that the scene doesn't have."""
    tolerance: float = 2.0
    """Differences below this are ignored [mm]."""
    write_scene: pathlib.Path | None = None
    """With --recommend: write the recommended scene to this file (.toml)."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write the rows to this file, as JSON."""
    source: MotionSource = dataclasses.field(default_factory=lambda: MotionSource(frames=20))
    outfit: Outfit = dataclasses.field(default_factory=Outfit)
    simulation: EffectOptions = dataclasses.field(default_factory=EffectOptions)
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Inspect:
    """Inspect garments, motions and rigged persons: properties, problems and how to fix them.

    Examples:
      physxnet inspect my_shirt.obj
      physxnet inspect coat.glb coat.glb#sleeves --json
      physxnet inspect dance.bvh walk.amc
    """

    files: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    """Garments (.obj, .glb, .gltf, .usd, .usda, .usdc, .usdz, .ply, .stl; coat.glb#sleeves is one
    mesh of several), motions (.bvh, .amc, .npz, .pkl, .vrma, .glb and .gltf without a mesh,
    built-in clips) or rigged persons (.vrm, .glb, .gltf)."""
    motion: bool = False
    """Inspect the animation of a .glb or .gltf file that also has a mesh."""
    source_fps: float | None = None
    """True frame rate of the motion files, if their headers are wrong."""
    skeleton: pathlib.Path | None = None
    """The ASF file of AMC files."""
    up: Literal["y", "z"] | None = None
    """Axis of the motion files that points up, if it isn't found right."""
    joint_map: pathlib.Path | None = None
    """TOML file for unknown joint names of the motion files, with lines like Hips = "pelvis"."""
    terminal: JsonTerminal = dataclasses.field(default_factory=JsonTerminal)


@dataclasses.dataclass(frozen=True)
class Fit:
    """Repair a garment file: place, weld, clean and orient it, and clear the skin.

    Examples:
      physxnet fit my_shirt.obj -o my_shirt_fitted.obj
      physxnet fit scan.obj --like dress --decimate 12 -o scan_fitted.obj
      physxnet fit tank_top.glb --drape -o tank_top_fitted.obj
    """

    file: tyro.conf.Positional[pathlib.Path]
    """A garment file that `physxnet inspect` reads; it isn't changed."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """The OBJ to write: metres, Y up, on the body at rest."""
    like: Literal["top", "bottom", "dress"] | None = None
    """Rotate, scale and move it to match this template, instead of guessing its unit."""
    edge_length: float | None = None
    """Split edges that are longer than this [mm]."""
    decimate: float | None = None
    """Before edges are split, decimate it to about this edge length [mm]."""
    drape: bool = False
    """Finally settle it on the body under its weight, for straps that don't touch the body."""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class ExportRest:
    """Write the body at rest and templates on it as OBJ files, to model garments on.

    Units are metres, Y is up, the origin is in the pelvis and the arms are 45 degrees down.
    A garment modelled on the default shape fits other shapes, too; --shape exports one of them.

    Examples:
      physxnet export-rest -o rest
      physxnet export-rest --wear top dress -o rest
    """

    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for body.obj and a file for each template."""
    wear: tuple[Literal["top", "bottom", "dress"], ...] = ("top", "bottom", "dress")
    """Templates to write as well, fitted to that shape."""
    shape: tuple[str, ...] = ()
    """Shape parameters, as name=value: gender=1 weight_up=0.5 …"""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Tailor:
    """Cut a garment to measure and write it at rest, for other programs.

    The mesh has its pattern in metres as texture coordinates; measures, fabric and held vertices
    stand in a .json file beside it. `physxnet clips` lists the kinds.

    Examples:
      physxnet tailor tee:ease=0.12,length=0.55 -o tee.obj
      physxnet tailor skirt:flare=0.6,fabric=denim -o skirt.glb --shape weight_up=0.5
    """

    garment: Annotated[str, tyro.conf.Positional]
    """Kind and measures [m]: tee:ease=0.12,length=0.55."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """The file: .obj, .glb, .usd, .usdc or .usda."""
    shape: tuple[str, ...] = ()
    """Shape parameters of the person, as name=value: gender=1 weight_up=0.5 …"""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Demo:
    """Dress a built-in walk: writes demo.usdc, demo.mp4 and demo.png.

    Examples:
      physxnet demo --out out
    """

    out: pathlib.Path = pathlib.Path("out")
    """Output folder."""
    frames: int | None = None
    """Stop after this many frames."""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Print versions, devices and optional packages; reject a faulty jaxlib.

    Examples:
      physxnet doctor
      physxnet doctor --json
    """

    terminal: JsonTerminal = dataclasses.field(default_factory=JsonTerminal)


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Time all dressing methods once on this machine; --budget-ms uses the times.

    Times are stored in $XDG_CACHE_HOME or ~/.cache. An interrupted run resumes where it stopped.

    Examples:
      physxnet calibrate
    """

    again: bool = False
    """Discard earlier measurements."""
    terminal: Terminal = dataclasses.field(default_factory=Terminal)


@dataclasses.dataclass(frozen=True)
class Clips:
    """List the built-in clips, templates and weights.

    Examples:
      physxnet clips
      physxnet clips --json
    """

    terminal: JsonTerminal = dataclasses.field(default_factory=JsonTerminal)


@dataclasses.dataclass(frozen=True)
class View:
    """Open the viewer in a browser: motions, garments, methods, shapes, errors, maps.

    It accepts connections from this machine only. Over ssh, forward its port:
    ssh -L 8080:localhost:8080 machine

    Examples:
      physxnet view
      physxnet view dance.bvh --wear my_shirt.obj bottom
      physxnet view walk --wear dress --html walk.html
      physxnet view punch --wear top --method simulate --wind 0 0 4 --fabric silk
    """

    motion: tyro.conf.Positional[str] = "walk"
    """A .bvh, .amc, .glb, .gltf, .vrma, .npz or .pkl file, or a clip of `physxnet clips`."""
    method: Literal["guided", "network", "lbs", "simulate"] = "guided"
    """network, guided, lbs (skinning alone) or simulate."""
    compare: bool = False
    """Also simulate the same clothes, and colour by the distance between both."""
    live: bool = False
    """Compute each frame when it is shown, and report the time."""
    shape: tuple[str, ...] = ()
    """Shape parameters, as name=value: gender=1 weight_up=0.5 …"""
    character: pathlib.Path | None = None
    """A rigged character (.glb, .gltf, .vrm) that moves in place of the built-in body."""
    source: MotionSource = dataclasses.field(default_factory=lambda: MotionSource(frames=150))
    outfit: Outfit = dataclasses.field(default_factory=Outfit)
    inference: InferenceOptions = dataclasses.field(default_factory=InferenceOptions)
    simulation: SimulationOptions = dataclasses.field(default_factory=SimulationOptions)
    html: pathlib.Path | None = None
    """Write a self-contained HTML page, and exit."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 accepts connections from the whole network."""
    port: int = 8080
    """Port to listen on; the next free one if it is in use."""
    browser: bool = True
    """Open the browser."""
    terminal: QuietTerminal = dataclasses.field(default_factory=QuietTerminal)


@dataclasses.dataclass(frozen=True)
class Export:
    """Export clothes as one function that needs only jax and flatbuffers.

    Examples:
      physxnet export --wear top bottom --out out/dresser
    """

    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the function (StableHLO), triangles, a card and a loader."""
    fps: float = 30.0
    """Frame rate of the function's input motion [1/s]."""
    platforms: tuple[str, ...] = ("cpu", "cuda")
    """Platforms that it will run on."""
    outfit: Outfit = dataclasses.field(default_factory=Outfit)
    inference: InferenceOptions = dataclasses.field(default_factory=InferenceOptions)
    terminal: Terminal = dataclasses.field(default_factory=Terminal)
