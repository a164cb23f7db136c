"""Rollouts: cloth positions, diagnostics and status flags."""

import dataclasses
import enum

import numpy as np
from jaxtyping import Bool, Float, Int

from ..errors import SimulationError
from ..frames import moved_frames


class Status(enum.IntFlag):
    """Problems found in a frame; 0 means none."""

    NONFINITE = 1
    """A NaN or an infinity."""
    UNCONVERGED = 2
    """The 99th percentile of the vertices' residuals is above 1."""
    STRAINED = 4
    """More than one edge in a hundred is longer than 1.5 times its rest length."""
    INSIDE = 8
    """A vertex more than 1 cm inside the body."""
    MISSED = 16
    """For many vertices contact may have missed the closest skin, see `BodyContact`."""
    FAST = 32
    """A vertex faster than 50 m/s."""
    PINCHED = 64
    """Many vertices lie inside another limb because the body intersects itself."""
    CROSSED = 128
    """More than one vertex in two hundred is on the wrong side of another layer."""
    OVERFLOW = 256
    """A grid cell of `SelfContact` received more vertices than it can hold."""
    OFF = 512
    """A garment's waist, upper border or neckline has slid more than 8 cm along the body."""
    COLLAPSED = 1024
    """More than one edge in ten has lost four fifths of its length."""

    @property
    def advice(self) -> str:
        """What a person can do about it; empty for a combination of flags."""
        return _ADVICE.get(self, "")


_STRAIN, _INSIDE, _SPEED = 0.5, 0.01, 50.0
OFF = 0.08
"""A garment whose waist, upper border or neckline has slid farther than this is off [m]."""
# Single vertices in armpits do no harm: this share of all is "many".
_MANY = 0.02
# Folds shorten no edge: cloth that has lost these is a heap or a point.
_COLLAPSED = 0.1
# Between layers less than that shows.
_CROSSING = 0.005
_ADVICE = {
    Status.NONFINITE: "look for a jump in the motion, or try --accuracy fine",
    Status.UNCONVERGED: "--accuracy fine",
    Status.STRAINED: "a garment too tight, or triangles without area: physxnet inspect GARMENT",
    Status.INSIDE: "cloth is caught in the body: start from another pose, or a looser garment",
    Status.MISSED: "the motion is too fast for one search a frame: --accuracy fine",
    Status.FAST: "a jump in the motion: cut the clip with --start and --frames",
    Status.PINCHED: "limbs pass through the body: correct the motion there",
    Status.CROSSED: "less wind, or --accuracy fine",
    Status.OVERFLOW: "a coarser mesh: physxnet fit GARMENT --edge-length",
    Status.COLLAPSED: "cloth has shrunk to a heap: look at its first frame and its rest shape",
    Status.OFF: "a closer fit, or hold it: skirt:hold=waist",
}
_CAUSES = {
    Status.FAST: "a teleport in the motion",
    Status.STRAINED: "a garment too tight or degenerate triangles in it",
    Status.INSIDE: "cloth trapped in the body",
    Status.UNCONVERGED: "too few substeps",
}


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Result of a simulation.

    Attributes:
        positions: Cloth positions of each garment [m], shapes [frames, vertices, 3].
        fps: Frames per second.
        diagnostics: Values of each frame: ``finite``, ``speed_max`` [m/s],
            ``worst_vertex`` (the fastest), ``residual_max`` and ``residual_p99``
            (1 is the tolerance of 0.5 mm). The scene's effects add ``strain_max``,
            ``strain_p99`` [1], ``collapsed`` (share of edges that have lost their length),
            ``penetration_max`` [m], ``inside_share``, ``missed``,
            ``pinched`` (vertices), ``layers_crossed``, ``layers_depth`` [m],
            ``self_gap`` [m] and ``overflow``; ``energy_...`` [J] if requested. ``slipped`` [m] is
            how far the garment that slid farthest has slid, see `slipped`.
        name: Name of the motion.
        vertices: Number of vertices that were simulated, if there were more than are returned.
    """

    positions: tuple[Float[np.ndarray, "frames _ 3"], ...]
    fps: float
    diagnostics: dict[str, np.ndarray]
    name: str = ""
    vertices: int | None = None

    def moved(self, by: Float[np.ndarray, "3"]) -> "Rollout":
        """The rollout with all positions displaced [m]."""
        if not by.any():
            return self
        return dataclasses.replace(
            self, positions=tuple(moved_frames(x, by) for x in self.positions)
        )

    @property
    def finite(self) -> Bool[np.ndarray, " frames"]:
        """Which frames contain neither NaN nor infinity."""
        return self.diagnostics["finite"].astype(bool)

    @property
    def worst(self) -> dict[str, float]:
        """Worst value of each diagnostic: the minimum of gaps, the maximum of all others."""
        per_frame = ("finite", "worst_vertex", "milliseconds")
        return {
            k: float(np.min(v) if k == "self_gap" else np.max(v))
            for k, v in self.diagnostics.items()
            if k not in per_frame
        }

    @property
    def status(self) -> Int[np.ndarray, " frames"]:
        """`Status` bits of each frame."""
        d = self.diagnostics
        nothing = np.zeros(len(self.finite))
        vertices = self.vertices or sum(x.shape[1] for x in self.positions)
        many = _MANY * vertices

        def bit(flag: Status, wrong: np.ndarray) -> np.ndarray:
            return np.where(wrong, int(flag), 0)

        return (
            bit(Status.NONFINITE, ~self.finite)
            | bit(Status.UNCONVERGED, ~(d["residual_p99"] <= 1.0))
            | bit(Status.STRAINED, ~(d.get("strain_p99", nothing) <= _STRAIN))
            | bit(Status.INSIDE, ~(d.get("penetration_max", nothing) <= _INSIDE))
            | bit(Status.MISSED, d.get("missed", nothing) > many)
            | bit(Status.FAST, ~(d["speed_max"] <= _SPEED))
            | bit(Status.PINCHED, d.get("pinched", nothing) > many)
            | bit(Status.CROSSED, d.get("layers_crossed", nothing) > _CROSSING * vertices)
            | bit(Status.OVERFLOW, d.get("overflow", nothing) > 0)
            | bit(Status.COLLAPSED, ~(d.get("collapsed", nothing) <= _COLLAPSED))
            | bit(Status.OFF, d.get("slipped", nothing) > OFF)
        )

    def check(self) -> None:
        """Raises if a frame isn't finite.

        Raises:
            SimulationError: A frame isn't finite. The message names the frame, the vertex
                and the likely causes, taken from the status of the preceding frames.
        """
        if self.finite.all():
            return
        frame = int(np.argmin(self.finite))
        vertex = int(self.diagnostics["worst_vertex"][frame])
        before = int(np.bitwise_or.reduce(self.status[max(frame - 5, 0) : frame], initial=0))
        likely = [text for flag, text in _CAUSES.items() if before & flag]
        raise SimulationError(
            f"{self.name or 'motion'}: frame {frame}, vertex {vertex} is not finite; likely"
            f" {' or '.join(likely[:2] or ['a value in the input that is not finite'])}."
            " Try accuracy='fine'; see Rollout.status of the preceding frames."
        )
