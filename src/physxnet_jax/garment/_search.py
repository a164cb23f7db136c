"""Searches for the unit, axes, pose and position that put a garment's mesh on the body."""

import copy
import dataclasses
import itertools
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..geometry import boundary_loops
from ._openings import Opening, openings
from ._poses import POSES, PosedBody

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "inch": 0.0254, "mm": 0.001}
AXES = ("x", "-x", "y", "-y", "z", "-z")
# Sizes that garments have, and that small ones may have [m].
_SIZES, _SMALL = (0.3, 2.4), (0.08, 2.6)
# How far templates of SMPL and SMPL-X have to be raised [m], and how much rarer frames are [m].
FRAMES = {"SMPL": 0.25, "SMPL-X": 0.36}
_RARE = {"SMPL": 0.001, "SMPL-X": 0.005}
# Distances count up to this, vertices count as deep beyond that [m], and what depth costs [m].
_FAR, _DEEP, _DEPTH_COST = 0.12, 0.015, 0.2
# Depth from which a point counts as inside [m], and what that costs [m].
_SHALLOW, _INSIDE_COST = 0.003, 0.06
# Costs: of openings that hold no limb, of sleeves or a waist without the rest of a person, of a
# neckline that is lower at the back (for each metre, up to a bound), of a pose of limbs that no
# sleeve or leg holds; of a pose other than rest, of another direction than the usual one [m]; of a
# shift [1].
_EMPTY, _INCOMPLETE, _BACK, _MAX_BACK, _NO_TUBE = 0.03, 0.03, 0.6, 0.05, 0.005
_POSED, _TURNED, _TILTED, _MOVED = 0.001, 0.001, 0.02, 0.01
# A longer border isn't a neckline [m].
_NECKLINE = 1.3
# How far a garment may reach beyond the template's height [m].
_MARGIN = 0.03
# A known frame is kept up to this cost over that of the best place [m], relative to it [1].
_KEPT, _KEPT_RATIO = 0.002, 1.2
# A garment that is held stays in its file's place, unless the best misfit is below this share of
# its own [1], or more than this speaks against it [m].
_FREE_RATIO, _MAX_DOUBT = 0.6, 0.01
# Below this cost, nothing else is tried [m].
_GOOD = 0.018
# A garment that is held lies this near the skin [m], with that share of it; and is inside with
# less than this share [1].
_CONTACT, _HELD, _INSIDE = 0.03, 0.03, 0.05
# Share of vertices on either side that may be strays, and their number in a coarse mesh.
_ODD, _FEW = 0.002, 3
_COARSE, _FINE, _GRID, _BEST = 160, 800, 0.05, 8
_POSES = ("rest", "T-pose")


class Turn(NamedTuple):
    """A rotation of a file's axes.

    Attributes:
        up: The file's axis that points up.
        degrees: The turn about it after that.
        matrix: The rotation, shape [3, 3].
    """

    up: str
    degrees: int
    matrix: Float[np.ndarray, "3 3"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Candidate:
    """A place of a garment on a posed body, and the evidence for it.

    Attributes:
        cost: What candidates are compared by [m].
        misfit: Mean distance to the skin, and a part for vertices in the body [m].
        unit: Name of the unit, or the scale as text.
        scale: Metres for each of the file's units.
        turn: Rotation of the file's axes.
        pose: The body's pose, a key of `POSES`.
        shift: Translation after scale and rotation [m], shape [3].
        frame: ``origin``, ``floor``, ``SMPL``, ``SMPL-X``, ``template`` or ``found``.
        openings: Openings and the limbs that pass through them.
        held: Whether some of it lies near the skin and nearly nothing in the body.
    """

    cost: float
    misfit: float
    unit: str
    scale: float
    turn: Turn
    pose: str
    shift: Float[np.ndarray, "3"]
    frame: str
    openings: list[Opening]
    held: bool

    def apply(self, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """Positions on the posed body [m]."""
        return vertices @ self.turn.matrix.T * self.scale + self.shift


def turns(up: str | None, front: str | None, *, every: bool = False) -> list[Turn]:
    """Rotations of a file's axes: upright, facing forwards or backwards.

    Args:
        up: The axis that points up, one of `AXES`; Y and Z are tried if None.
        front: The axis that the garment faces; both directions are tried if None.
        every: Whether to try X up and sideways directions too.
    """
    ups = (up,) if up else ("y", "z", "x") if every else ("y", "z")
    out = []
    for u in ups:
        upwards = _axis(u)
        # The usual front: Z where Y is up, -Y where Z is up.
        usual = {"y": "z", "-y": "z", "z": "-y", "-z": "-y", "x": "z", "-x": "z"}[u]
        for degrees in (0, 90, 180, 270) if every or front else (0, 180):
            f = _axis(usual)
            for _ in range(degrees // 90):
                f = np.cross(upwards, f)
            if front and not np.array_equal(f, _axis(front)):
                continue
            matrix = np.stack([np.cross(upwards, f), upwards, f])
            out.append(Turn(u.upper(), degrees, matrix))
    return out


def _axis(name: str) -> Float[np.ndarray, "3"]:
    return np.eye(3)["xyz".index(name[-1])] * (-1.0 if name[0] == "-" else 1.0)


def plausible_units(size: float) -> dict[str, float]:
    """Units in which a mesh of this size is a garment; if there are none, a small one."""
    for low, high in (_SIZES, _SMALL):
        found = {name: scale for name, scale in UNITS.items() if low <= size * scale <= high}
        if found:
            return found
    return {}


def misfit(posed: PosedBody, points: Float[np.ndarray, "points 3"]) -> tuple[float, float, float]:
    """Misfit of points to a posed body [m], the share held near the skin, and that inside."""
    distance, nearest = posed.tree.query(points)
    skin = posed.tree.data[nearest]
    depth = np.einsum("ij,ij->i", skin - points, posed.normals[nearest])
    inside = float(np.mean(depth > _SHALLOW))
    cost = np.minimum(distance, _FAR).mean() + _DEPTH_COST * np.mean(depth > _DEEP)
    return float(cost) + _INSIDE_COST * inside, float(np.mean(distance < _CONTACT)), inside


def surface_points(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], count: int
) -> Float[np.ndarray, "count 3"]:
    """Points spread over a surface, the same ones in each call."""
    corner = vertices[faces]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    if not area.sum() > 0.0:
        return vertices[:count]
    rng = np.random.default_rng(0)
    # At even steps of the area, so that small parts get their share.
    along = (np.arange(count) + 0.5) / count * area.sum()
    face = np.minimum(np.searchsorted(np.cumsum(area), along), len(faces) - 1)
    return np.einsum("nk,nkc->nc", rng.dirichlet(np.ones(3), count), corner[face])


def strays(vertices: Float[np.ndarray, "vertices 3"]) -> Bool[np.ndarray, " vertices"]:
    """Which vertices lie farther beyond almost all others than these extend.

    A vertex left behind in another corner of a scene would be most of a garment's size.
    """
    few = min(max(_FEW, math.ceil(_ODD * len(vertices))), len(vertices) // 8)
    ordered = np.sort(vertices, axis=0)
    low, high = ordered[few], ordered[len(vertices) - 1 - few]
    margin = float((high - low).max())
    return ((vertices < low - margin) | (vertices > high + margin)).any(axis=1)


def drawn_in(vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
    """Vertices with strays moved to the box of all others."""
    odd = strays(vertices)
    if not odd.any() or odd.all():
        return vertices
    kept = vertices[~odd]
    return np.clip(vertices, kept.min(axis=0), kept.max(axis=0))


class Search:
    """The search for one mesh; candidates are made by `known` and `found`.

    Args:
        vertices: Vertices in the file's unit and axes.
        faces: Triangles.
        poses: The body in its poses.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        faces: Int[np.ndarray, "faces 3"],
        poses: dict[str, PosedBody],
    ) -> None:
        self.region: tuple[Float[np.ndarray, 3], Float[np.ndarray, 3]] | None = None
        self.costs: dict[tuple[str, str, int, float, bytes], float] = {}
        self.vertices, self.poses = drawn_in(np.asarray(vertices, np.float64)), poses
        self.coarse = surface_points(self.vertices, faces, _COARSE)
        self.fine = surface_points(self.vertices, faces, _FINE)
        self.loops = boundary_loops(faces)
        self.rims = np.unique(np.concatenate([np.zeros(0, int), *self.loops]))
        self.box = np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])
        self.floor = float(np.asarray(poses["rest"].skin.vertices)[:, 1].min())

    def for_region(self, region: Float[np.ndarray, "others 3"]) -> "Search":
        """The search for a template's place, which shares what is known of other places.

        Args:
            region: Vertices of the template [m]: the mesh may not reach beyond its height by
                much, and its bounding box is one more known frame.
        """
        other = copy.copy(self)
        other.region = region.min(axis=0), region.max(axis=0)
        return other

    def _misfit(self, scale: float, turn: Turn, pose: str, shift: np.ndarray) -> float:
        """Misfit of the coarse points [m], computed once."""
        key = (pose, turn.up, turn.degrees, scale, shift.tobytes())
        if key not in self.costs:
            points = self.coarse @ turn.matrix.T * scale + shift
            self.costs[key] = misfit(self.poses[pose], points)[0]
        return self.costs[key]

    def judge(
        self, unit: str, scale: float, turn: Turn, pose: str, shift: np.ndarray, frame: str
    ) -> Candidate:
        """Evaluates a candidate in full."""
        posed = self.poses[pose]

        def place(x: np.ndarray) -> np.ndarray:
            return x @ turn.matrix.T * scale + shift

        fit, near, inside = misfit(posed, place(self.fine))
        # Of its vertices, only those of its borders are read.
        rims = np.zeros_like(self.vertices)
        rims[self.rims] = place(self.vertices[self.rims])
        found = openings(rims, self.loops, posed.limbs)
        cost = fit + self._evidence(rims, found, pose)
        cost += self._outside(place(self.fine))
        cost += _POSED * (pose != "rest") + _turned(turn) + _RARE.get(frame, 0.0)
        if frame == "found" and self.region is None:
            known = [0.0, self.floor, *FRAMES.values()]
            cost += _MOVED * min(abs(shift[1] - y) for y in known) + _MOVED * abs(shift[0])
        return Candidate(
            cost=float(cost),
            misfit=fit,
            unit=unit,
            scale=scale,
            turn=turn,
            pose=pose,
            shift=shift,
            frame=frame,
            openings=found,
            held=bool(near > _HELD and inside < _INSIDE),
        )

    def _evidence(self, vertices: np.ndarray, found: list[Opening], pose: str) -> float:
        """Cost of what speaks against a place [m].

        That is openings without limbs, a low nape, or a pose of limbs that have no tube.
        """
        cost = 0.0
        if len(found) > 1:
            cost += _EMPTY * sum(not o.limbs for o in found) / len(found)
        single = {o.limbs[0] for o in found if len(o.limbs) == 1}
        through = {limb for o in found for limb in o.limbs}
        arms, legs = POSES[pose]
        if arms is not None and not single & {"left arm", "right arm"}:
            cost += _NO_TUBE * (legs is None or not single & {"left leg", "right leg"})
        if legs and not single & {"left leg", "right leg"}:
            cost += _NO_TUBE
        # Sleeves belong to something that the head comes out of.
        if single & {"left arm", "right arm"} and "head" not in through:
            cost += _INCOMPLETE
        for o in found:
            if o.limbs == ("head",) and o.around < _NECKLINE:
                ring = vertices[o.loop]
                lower = ring[ring[:, 2].argmax(), 1] - ring[ring[:, 2].argmin(), 1]
                cost += float(np.clip(_BACK * lower, 0.0, _MAX_BACK))
        return cost

    def known(
        self, units: dict[str, float], turned: Iterable[Turn], poses: Iterable[str]
    ) -> list[Candidate]:
        """Candidates in the frames of known bodies: their origin, or the floor under them."""
        shifts = {"origin": 0.0, "floor": self.floor, **FRAMES}
        coarse = []
        for (unit, scale), turn, pose in itertools.product(units.items(), turned, poses):
            points = self.coarse @ turn.matrix.T * scale
            frames = {frame: np.array([0.0, y, 0.0]) for frame, y in shifts.items()}
            if self.region is not None:
                frames["template"] = self._aligned(scale, turn)
            for frame, shift in frames.items():
                cost = self._misfit(scale, turn, pose, shift) + _turned(turn)
                cost += self._outside(points + shift)
                coarse.append((cost, unit, scale, turn, pose, shift, frame))
        coarse.sort(key=lambda c: c[0])
        # As it is in its file, and the best ones.
        plain = [c for c in coarse if c[4] == "rest" and c[6] == "origin" and not c[3].degrees]
        chosen = {id(c): c for c in (*plain, *coarse[:_BEST])}.values()
        return sorted((self.judge(*c[1:]) for c in chosen), key=lambda p: p.cost)

    def found(self, units: dict[str, float], turned: Iterable[Turn]) -> list[Candidate]:
        """Candidates at any height, refined."""
        coarse, turned = [], list(turned)
        grid = _GRID if len(turned) * len(units) < 8 else 2.0 * _GRID
        for (unit, scale), turn, pose in itertools.product(units.items(), turned, _POSES):
            points = self.coarse @ turn.matrix.T * scale
            for shift in self._grid(scale, turn, grid):
                cost = self._misfit(scale, turn, pose, shift) + _turned(turn)
                cost += self._outside(points + shift)
                coarse.append((cost, unit, scale, turn, pose, shift))
        coarse.sort(key=lambda c: c[0])
        best = []
        for _, unit, scale, turn, pose, shift in _distinct(coarse):
            # Arms or legs may be between those of the poses so far.
            names = self.poses if pose == _POSES[1] else ("rest",)
            cost = {n: self._misfit(scale, turn, n, shift) for n in names}
            for name in sorted(cost, key=cost.__getitem__)[:2]:
                refined = self._refine(scale, turn, name, shift)
                best.append(self.judge(unit, scale, turn, name, refined, "found"))
        return sorted(best, key=lambda p: p.cost)

    def _aligned(self, scale: float, turn: Turn) -> np.ndarray:
        """Shift that aligns the bounding box with the template's, at the top."""
        assert self.region is not None
        # Axes change places and signs, so that corners stay corners.
        x = self.box @ turn.matrix.T * scale
        held = np.where([False, True, False], x.max(axis=0), 0.5 * (x.min(axis=0) + x.max(axis=0)))
        low, high = self.region
        return np.where([False, True, False], high, 0.5 * (low + high)) - held

    def _outside(self, points: np.ndarray) -> float:
        """Cost of height beyond the template's [m]."""
        if self.region is None:
            return 0.0
        low, high = self.region[0][1] - _MARGIN, self.region[1][1] + _MARGIN
        return float(
            np.mean(np.maximum(points[:, 1] - high, 0) + np.maximum(low - points[:, 1], 0))
        )

    def _grid(self, scale: float, turn: Turn, step: float) -> list[np.ndarray]:
        """Shifts that put a mesh on the body's axis, at every height."""
        x = self.box @ turn.matrix.T * scale
        low, high = x.min(axis=0), x.max(axis=0)
        middle = 0.5 * (low + high)
        heights = np.arange(self.floor - 0.1 - low[1], 0.8 - high[1] + 1e-9, step)
        if not len(heights):
            heights = np.array([0.5 * (self.floor + 0.7) - middle[1]])
        return [np.array([-middle[0], y, 0.02 - middle[2]]) for y in heights]

    def _refine(self, scale: float, turn: Turn, pose: str, shift: np.ndarray) -> np.ndarray:
        """Moves a mesh by smaller and smaller steps to the smallest misfit."""
        points = self.fine @ turn.matrix.T * scale
        posed = self.poses[pose]
        shift, best = shift, misfit(posed, points + shift)[0]
        for step in (0.03, 0.015, 0.007, 0.003):
            for axis in (1, 2, 1, 2):
                for sign in (-1.0, 1.0):
                    other = shift + sign * step * np.eye(3)[axis]
                    cost = misfit(posed, points + other)[0]
                    if cost < best - 1e-5:
                        best, shift = cost, other
                        break
        return shift


def _turned(turn: Turn) -> float:
    return _TURNED * (turn.degrees != 0) + _TILTED * (turn.up not in "YZ")


def _distinct(candidates: list[tuple]) -> list[tuple]:
    """The best candidates, no two of them neighbours of one unit, direction and pose."""
    out: list[tuple] = []
    for c in candidates:
        near = (
            o[1] == c[1]
            and o[3][:2] == c[3][:2]
            and o[4] == c[4]
            and abs(o[5][1] - c[5][1]) < 2.5 * _GRID
            for o in out
        )
        if not any(near):
            out.append(c)
        if len(out) == _BEST:
            break
    return out


def choose(search: Search, units: dict[str, float], turned: list[Turn]) -> Candidate | None:
    """The place that the evidence speaks for; None if there is no unit to try.

    Frames of known bodies are preferred to places that fit slightly better.
    """
    if not units:
        return None
    known = search.known(units, turned, _POSES)
    if known[0].cost < _GOOD:
        return known[0]
    found = search.found(units, turned)
    best = min(found, key=lambda p: p.cost)
    # Capes touch little of a body, so their distance says little: they stay where they are held.
    for p in known:
        as_is = p.frame == "origin" and p.pose == "rest" and p.turn is turned[0]
        undoubted = p.cost - p.misfit < _MAX_DOUBT and best.misfit > _FREE_RATIO * p.misfit
        if as_is and p.held and undoubted:
            return p
    kept = [p for p in known if p.cost <= _KEPT_RATIO * best.cost + _KEPT]
    chosen = kept[0] if kept else best
    if chosen.frame == "origin" and chosen.pose == "rest":
        return chosen
    # Arms and legs may be between those of the poses so far.
    place = (chosen.unit, chosen.scale, chosen.turn)
    same = [search.judge(*place, pose, chosen.shift, chosen.frame) for pose in search.poses]
    return min(same, key=lambda p: p.cost)
