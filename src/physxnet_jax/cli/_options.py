"""Groups of options that commands share, as dataclasses that tyro reads."""

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ..errors import PhysXNetError
from ..jobs import LOCAL

if TYPE_CHECKING:
    from ..dressing import Inference, Simulation

Accuracy = Literal["draft", "standard", "fine", "reference"]


RayAddress = tuple[str, ...] | None
"""Of an option that may stand without a value."""


def ray_address(option: RayAddress) -> str | None:
    """The address for `run_jobs`.

    Raises:
        PhysXNetError: More than one address.
    """
    if option is None:
        return None
    if len(option) > 1:
        raise PhysXNetError(f"--ray takes one address, got {' '.join(option)}.")
    return option[0] if option else LOCAL


@dataclasses.dataclass(frozen=True)
class InferenceOptions:
    """Network and post-processing."""

    weights: str = "base"
    """Name or folder of network weights (see `physxnet clips`)."""
    tta: bool = False
    """Average with the prediction for the mirrored pose (test-time augmentation)."""
    strain_iterations: int = 8
    """Iterations of strain limiting after the network; 0 disables it."""
    collisions: bool = True
    """Resolve collisions: move vertices inside the body onto it, keep garments in layers."""

    def build(self) -> "Inference":
        """Builds the options of the Python API."""
        from ..dressing import Inference

        return Inference(**dataclasses.asdict(self))


@dataclasses.dataclass(frozen=True)
class EffectOptions:
    """Simulation."""

    accuracy: Accuracy | None = None
    """Accuracy of the simulation; higher accuracy takes more time. By default that of the scene
    file, else standard."""
    wind: tuple[float, float, float] | None = None
    """Steady wind [m/s]."""
    self_contact: bool = False
    """Let garments collide with themselves."""
    floor: bool | None = None
    """Whether there is a floor; by default where a garment reaches down to it, or the person
    kneels, sits or lies."""

    def build(self) -> "Simulation":
        """Builds the options of the Python API."""
        from ..dressing import Simulation

        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Simulation(**{k: v for k, v in given.items() if v is not None})


@dataclasses.dataclass(frozen=True)
class SimulationOptions(EffectOptions):
    """Simulation."""

    engine: Literal["xpbd", "bdf2", "blender", "newton"] = "xpbd"
    """bdf2: implicit, second order. blender, newton: external processes (PHYSXNET_BLENDER,
    PHYSXNET_NEWTON)."""
    substeps: int | None = None
    """Steps a frame at 30 frames per second, in place of --accuracy; 8 with --method guided."""
    refine: float | None = None
    """Split longer edges of the garments while they are simulated [m]; the result is on the
    files' own vertices."""


@dataclasses.dataclass(frozen=True)
class MotionSource:
    """Motion."""

    fps: float = 30.0
    """Frame rate of the result [1/s]."""
    start: float = 0.0
    """Start at this time of the motion [s]."""
    frames: int | None = None
    """Stop after this many frames."""
    source_fps: float | None = None
    """True frame rate of the motion file, if its header is wrong or lacks it."""
    animation: str | None = None
    """Name of the animation in a glTF file with several (as FILE#NAME); the longest by default."""
    up: Literal["y", "z"] | None = None
    """Axis of the motion file that points up, if it isn't found right."""
    skeleton: pathlib.Path | None = None
    """The ASF file of an AMC file, if it isn't in the same folder."""
    joint_map: pathlib.Path | None = None
    """TOML file for unknown joint names of the motion file, with lines like Hips = "pelvis"."""


@dataclasses.dataclass(frozen=True)
class Outfit:
    """Outfit."""

    wear: tuple[str, ...] = ("shirt", "trousers")
    """Tailored garments (tee, shirt, trousers, skirt, aline and others, see `physxnet clips`),
    templates (top, bottom, dress) and files (.obj, .glb, .gltf, .usd*, .ply, .stl), with options
    after a colon: tee:ease=0.12,length=0.5 or coat.obj:as=top,fabric=wool. Tops go over dresses
    and skirts, these over trousers; among garments of one type, later ones are outer."""
    fabric: str | None = None
    """Fabric of all garments that don't name one: cotton, denim, silk, wool, jersey or leather, or
    a file of numbers (fabric.toml)."""
    made_on: pathlib.Path | None = None
    """Mesh of the body that the garment files were made on, in the same place as they."""

    @property
    def words(self) -> tuple[str, ...]:
        """The garments, with the default fabric and body for those that don't name one."""
        from ..garment import with_default_fabric, with_made_on

        return with_made_on(with_default_fabric(self.wear, self.fabric), self.made_on)


@dataclasses.dataclass(frozen=True)
class BodyOptions:
    """Body."""

    shape: tuple[str, ...] = ()
    """Shape parameters, as name=value: gender=1 weight_up=0.5 …"""
    animated_body: bool = False
    """The motion file is an animated person to dress: .glb, .usd, .pc2, .mdd (with OBJ), .npz."""
    character: pathlib.Path | None = None
    """A rigged character (.glb, .gltf, .vrm) that the motion drives."""
    character_map: pathlib.Path | None = None
    """TOML file for unknown joint names of --character, with lines like Hips = "pelvis"."""
    body_mesh: str | None = None
    """Name of the body's mesh in a file with several, for --animated-body and --character."""


@dataclasses.dataclass(frozen=True)
class Output:
    """Output."""

    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Result: .usdc, .usd, .usda, .pc2, .mdd (with OBJ), .glb, .html, .obj (one a frame), .npz."""
    preview: pathlib.Path | None = None
    """Image or video: .png, .gif or .mp4."""
    body: bool = True
    """Include the body in the result."""
    velocities: bool = False
    """USD: include velocities of the garments, for motion blur."""
    strict: bool = False
    """Exit with code 1 if a simulated garment slides off the body."""

    @property
    def unfinished(self) -> pathlib.Path | None:
        """Folder of finished blocks, beside what they will become."""
        first = self.out or self.preview
        return None if first is None else first.with_name(f".{first.name}.unfinished")


@dataclasses.dataclass(frozen=True)
class PreviewOptions:
    """Preview."""

    size: tuple[int, int] = (480, 544)
    """Width and height of the preview; multiples of 16 for .mp4."""
    camera: Literal["three-quarter", "front", "back", "follow", "turntable"] = "three-quarter"
    """three-quarter, front and back keep their direction, follow turns with the person, turntable
    goes around once; all keep the person in the middle."""
    background: str = "studio"
    """studio, white, grey, dark or #rrggbb."""
    strip: int = 1
    """Number of moments side by side in a .png."""


@dataclasses.dataclass(frozen=True)
class _Debug:
    debug: bool = False
    """Show the traceback of an error."""


@dataclasses.dataclass(frozen=True)
class JsonTerminal(_Debug):
    """Terminal."""

    json: bool = False
    """Print JSON instead of tables."""


@dataclasses.dataclass(frozen=True)
class QuietTerminal(_Debug):
    """Terminal."""

    quiet: bool = False
    """Print errors only."""
    progress: bool = False
    """Print progress as lines of JSON on stderr, for other programs."""


@dataclasses.dataclass(frozen=True)
class Terminal(JsonTerminal, QuietTerminal):
    """Terminal."""


def changed(group: Any) -> list[str]:
    """Flags of a group that differ from their defaults."""
    defaults = type(group)()
    return [
        f"--{f.name.replace('_', '-')}"
        for f in dataclasses.fields(group)
        if getattr(group, f.name) != getattr(defaults, f.name)
    ]


def check_body(options: BodyOptions, source: MotionSource) -> None:
    """Checks that the body options are compatible.

    Raises:
        PhysXNetError: They aren't; the message names the options to leave out or to add.
    """
    if options.animated_body and (options.shape or source.joint_map or source.skeleton):
        raise PhysXNetError(
            "--animated-body has its own shape and needs no joints: leave out --shape,"
            " --joint-map and --skeleton."
        )
    if options.character is not None and (options.shape or options.animated_body):
        raise PhysXNetError(
            "--character has its own shape and is driven by the motion file: leave out"
            " --shape and --animated-body."
        )
    custom = options.animated_body or options.character is not None
    if options.body_mesh is not None and not custom:
        raise PhysXNetError(
            "--body-mesh selects a mesh of --animated-body or --character: add one of them."
        )
    if options.character_map is not None and options.character is None:
        raise PhysXNetError("--character-map names joints of --character: add --character.")
    if source.up is not None and options.animated_body:
        raise PhysXNetError(
            "--up is for motion files; an --animated-body declares it: leave it out."
        )


def with_animation(motion: str, source: MotionSource) -> str:
    """The motion's word with the name of its animation.

    Raises:
        PhysXNetError: It has a name already, or isn't a glTF file.
    """
    if source.animation is None:
        return motion
    from ..motion import split_animation

    named = f"{motion}#{source.animation}"
    if split_animation(motion)[1] is not None or split_animation(named)[1] is None:
        raise PhysXNetError(
            f"--animation selects an animation of one glTF file: leave it out for {motion}."
        )
    return named


def check_fabric(outfit: Outfit, method: str, weights: str) -> None:
    """Checks that a fabric is chosen only where it makes a difference.

    Raises:
        PhysXNetError: Neither a simulation nor the network sees it.
    """
    from ..garment import parse_wear
    from ..models import read_card

    if method in ("guided", "simulate") or not any(parse_wear(w).fabric for w in outfit.words):
        return
    if method == "lbs":
        raise PhysXNetError("--fabric, fabric=: skinning sees no fabric. Leave it out.")
    if not read_card(weights).get("model", {}).get("conditions", False):
        raise PhysXNetError(
            f"--fabric, fabric=: {weights} sees no fabric. Leave it out, or add --method guided or"
            " simulate."
        )


def check_simulates(
    method: str, simulation: SimulationOptions, outfit: Outfit, weights: str
) -> None:
    """Checks that options of the simulator are given to the simulator only.

    Raises:
        PhysXNetError: They aren't.
    """
    if method == "simulate":
        return
    for flag in changed(simulation):
        if method != "guided":
            raise PhysXNetError(
                f"{flag} is an option of the simulator: add --method guided or simulate."
            )
        if flag in ("--accuracy", "--engine", "--refine"):
            raise PhysXNetError(
                f"{flag} is for whole simulations: use --substeps, or --method simulate."
            )
    check_fabric(outfit, method, weights)
