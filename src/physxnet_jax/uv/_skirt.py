"""The chart of skirts: a hull around both legs, unrolled by angle and height."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body
from ..garment import Garment
from ..geometry import closest_barycentric
from ..typing import pytree
from ._rasterise import rasterise
from ._transference import Transference

# Heights in units of the leg from hip joint to ankle, above the hip: the chart's top, and the
# stretch in which a dress passes from the body's chart to this one.
_TOP, _BAND_TOP, _BAND_BOTTOM = 0.33, 0.21, 0.05
# Share of the half width over which the nearer leg takes over from the other.
_MIDDLE = 0.6
# Half the height over which the hull's outline is measured [m].
_SLICE = 0.03
_CANDIDATES = 16


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class SkirtChart:
    """Texels around both legs: columns by angle, the front in the middle; rows from the waist down.

    A texel moves with the nearest point of each half of the body, so the map of a skirt sees the
    motion of both legs.

    Attributes:
        left: Body vertices to texels: the nearest point of the person's left half.
        right: The same of the right half.
        share: Share of the left point, shape [texels].
        rows: Rows of the chart.
        columns: Columns of the chart.
    """

    left: Transference
    right: Transference
    share: Float[Array, " texels"]
    rows: int = dataclasses.field(metadata={"static": True})
    columns: int = dataclasses.field(metadata={"static": True})

    def __matmul__(
        self, values: Float[Array, "*batch vertices channels"]
    ) -> Float[Array, "*batch texels channels"]:
        """Values of body vertices at the texels."""
        share = self.share.reshape((1,) * (values.ndim - 2) + (-1, 1))
        other = self.right @ values
        return other + share * (self.left @ values - other)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hull:
    """An elliptic column around the legs of a body at rest.

    Attributes:
        heights: Heights at which it is measured, ascending [m].
        half_width: Half its extent to the sides [m].
        half_depth: Half its extent from front to back [m].
        middle: Where its axis lies between front and back [m].
        hip: Height of the hip joints [m].
        leg: Height of the hip joints above the ankles [m].
    """

    heights: Float[np.ndarray, " levels"]
    half_width: Float[np.ndarray, " levels"]
    half_depth: Float[np.ndarray, " levels"]
    middle: Float[np.ndarray, " levels"]
    hip: float
    leg: float

    @property
    def top(self) -> float:
        """Height of the chart's upper border [m]."""
        return self.hip + _TOP * self.leg

    def angle_and_drop(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Where points lie in the chart.

        Args:
            points: Positions at rest [m].

        Returns:
            Angles around the hull as shares of a turn, 0 behind and 0.5 in front; and how far
            down they lie as shares of the chart.
        """
        x, y, z = np.asarray(points, np.float64).T
        outline = (self.half_width, self.half_depth, self.middle)
        a, b, c = (np.interp(y, self.heights, values) for values in outline)
        turn = np.arctan2(x / a, (z - c) / b) / (2.0 * np.pi) + 0.5
        return turn, (self.top - y) / (self.top - (self.hip - self.leg))

    def points(
        self, turn: Float[np.ndarray, " points"], drop: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points 3"]:
        """Points of the hull [m], the inverse of `angle_and_drop`."""
        y = self.top - drop * (self.top - (self.hip - self.leg))
        outline = (self.half_width, self.half_depth, self.middle)
        a, b, c = (np.interp(y, self.heights, values) for values in outline)
        angle = 2.0 * np.pi * (turn - 0.5)
        return np.column_stack([a * np.sin(angle), y, c + b * np.cos(angle)])

    def share(
        self, heights: Float[np.ndarray, " points"], arms: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, " points"]:
        """How much of a point of a dress belongs to this chart, from 0 to 1; smooth.

        Args:
            heights: Its heights at rest [m].
            arms: Their skinning weights of the arms; sleeves stay on the body's chart.
        """
        top, bottom = self.hip + _BAND_TOP * self.leg, self.hip + _BAND_BOTTOM * self.leg
        t = np.clip((top - np.asarray(heights, np.float64)) / (top - bottom), 0.0, 1.0)
        return t * t * (3.0 - 2.0 * t) * np.clip(1.0 - 2.0 * np.asarray(arms), 0.0, 1.0)


def arm_weights(
    body: Body, weights: Float[np.ndarray, "points joints"]
) -> Float[np.ndarray, " points"]:
    """The sum of the skinning weights of both arms, hands included."""
    arms: list[int] = []
    for joint, parent in enumerate(body.parents):
        if joint in (body.joint("LeftArm"), body.joint("RightArm")) or parent in arms:
            arms.append(joint)
    return np.asarray(weights, np.float64)[:, arms].sum(axis=1)


def skirt_hull(body: Body, rest: Float[np.ndarray, "all 3"]) -> Hull:
    """The hull of a body at rest, from the outline of its hips and legs.

    Args:
        body: The body.
        rest: Its rest vertices [m].
    """
    trunk = arm_weights(body, np.asarray(body.weights)[:NUM_BODY_VERTICES]) < 0.2
    vertices = np.asarray(rest, np.float64)[:NUM_BODY_VERTICES][trunk]
    heads = np.asarray(rest, np.float64)[np.asarray(body.joint_rows)].mean(axis=2)[:, 0]
    hip, ankle = heads[body.joint("LeftUpLeg"), 1], heads[body.joint("LeftFoot"), 1]
    heights = np.linspace(ankle, hip + _TOP * (hip - ankle), 40)
    rings = [vertices[np.abs(vertices[:, 1] - y) < _SLICE] for y in heights]
    low = np.stack([ring.min(axis=0) for ring in rings])
    high = np.stack([ring.max(axis=0) for ring in rings])
    return Hull(
        heights=heights,
        half_width=np.maximum(-low[:, 0], high[:, 0]),
        half_depth=0.5 * (high[:, 2] - low[:, 2]),
        middle=0.5 * (high[:, 2] + low[:, 2]),
        hip=float(hip),
        leg=float(hip - ankle),
    )


def make_skirt_chart(body: Body, rows: int, columns: int) -> SkirtChart:
    """The chart of a body, at a resolution."""
    rest = np.asarray(body.rest_vertices(body.default_shape()))
    hull = skirt_hull(body, rest)
    turn = np.tile((np.arange(columns) + 0.5) / columns, rows)
    drop = np.repeat((np.arange(rows) + 0.5) / rows, columns)
    points = hull.points(turn, drop)
    faces = np.asarray(body.rest_mesh().faces)
    trunk = arm_weights(body, np.asarray(body.weights)[:NUM_BODY_VERTICES]) < 0.2
    faces = faces[trunk[faces].all(axis=1)]
    side = rest[faces, 0].mean(axis=1)
    halves = [_nearest(rest, faces[s * side > 0.0], points) for s in (1.0, -1.0)]
    t = np.clip(0.5 + 0.5 * np.sin(2.0 * np.pi * (turn - 0.5)) / _MIDDLE, 0.0, 1.0)
    share = jax.device_put((t * t * (3.0 - 2.0 * t)).astype(np.float32))
    return SkirtChart(left=halves[0], right=halves[1], share=share, rows=rows, columns=columns)


def _nearest(rest: np.ndarray, faces: np.ndarray, points: np.ndarray) -> Transference:
    vertices = rest[:NUM_BODY_VERTICES].astype(np.float32)
    # Among the faces whose centres are nearest: faces of a body are small.
    centres = rest[faces].mean(axis=1)
    candidates = KDTree(centres).query(points, _CANDIDATES)[1].astype(np.int32)
    corners = np.moveaxis(vertices[faces[candidates]], (2, 3), (0, 1))
    p = np.ascontiguousarray(points.astype(np.float32).T)
    _, squared = closest_barycentric(np.broadcast_to(p[:, :, None], corners[0].shape), *corners)
    rows = np.arange(len(points))
    nearest = np.asarray(candidates)[rows, np.argmin(squared, axis=1)]
    weights, _ = closest_barycentric(p, *np.moveaxis(vertices[faces[nearest]], 0, 2))
    return Transference(
        jax.device_put(faces[nearest].astype(np.int32)),
        jax.device_put(weights.T),
        jax.device_put(np.ones(len(points), bool)),
        NUM_BODY_VERTICES,
    )


def skirt_rows(
    chart: SkirtChart, hull: Hull, garment: Garment, share: Float[np.ndarray, " vertices"]
) -> Transference:
    """For each texel of the chart, the point of a garment there.

    Args:
        chart: The chart.
        hull: The hull of the body that the garment is on.
        garment: The garment.
        share: Which vertices belong to the chart at all, see `Hull.share`.

    Returns:
        Garment vertices to texels; ``valid`` where there is cloth.
    """
    turn, drop = hull.angle_and_drop(np.asarray(garment.mesh.vertices))
    faces = np.asarray(garment.mesh.faces)
    faces = faces[share[faces].max(axis=1) > 0.0]
    u = turn[faces]
    # A face across the seam lies on both sides of it.
    across = np.ptp(u, axis=1) > 0.5
    u = np.where(across[:, None] & (u < 0.5), u + 1.0, u)
    faces = np.concatenate([faces, faces[across]])
    u = np.concatenate([u, u[across] - 1.0])
    corners = np.column_stack([u.ravel(), 1.0 - drop[faces].ravel()])
    rows, columns = chart.rows, chart.columns
    out = np.zeros((rows * columns, 3), np.int32), np.zeros((rows * columns, 3), np.float32)
    valid = np.zeros(rows * columns, bool)
    if len(faces):
        own = np.arange(corners.shape[0], dtype=np.int32).reshape(-1, 3)
        texels, face, weights = rasterise(corners, own, rows, columns)
        out[0][texels], out[1][texels], valid[texels] = faces[face], weights, True
    return Transference(
        jax.device_put(out[0]), jax.device_put(out[1]), jax.device_put(valid), garment.num_vertices
    )


def skirt_samples(
    chart: SkirtChart,
    hull: Hull,
    points: Float[np.ndarray, "points 3"],
    valid: Bool[np.ndarray, " texels"],
) -> tuple[Int[np.ndarray, "points 4"], Float[np.ndarray, "points 4"], Bool[np.ndarray, " points"]]:
    """Bilinear weights over valid texels of the chart; columns go round.

    Returns:
        Texels of the chart, weights that sum to 1, and which points took the nearest texel
        because none around them is valid.
    """
    turn, drop = hull.angle_and_drop(points)
    rows, columns = chart.rows, chart.columns
    x = turn * columns - 0.5
    y = np.clip(drop * rows - 0.5, 0.0, rows - 1.0)
    x0, y0 = np.floor(x).astype(int), np.minimum(np.floor(y).astype(int), rows - 2)
    fx, fy = x - x0, y - y0
    texel = np.zeros((len(points), 4), np.int32)
    weight = np.zeros((len(points), 4))
    for k, (dx, dy) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        texel[:, k] = (y0 + dy) * columns + (x0 + dx) % columns
        weight[:, k] = np.where(dx, fx, 1 - fx) * np.where(dy, fy, 1 - fy)
    weight = np.where(valid[texel], weight, 0.0)
    total = weight.sum(axis=1)
    alone = total < 1e-3
    if alone.any() and valid.any():
        known = np.flatnonzero(valid)
        # Twice round, so that the seam is no border.
        grid = np.column_stack([known % columns, known // columns])
        turn_on = np.array([columns, 0])
        twice = np.concatenate([grid, grid + turn_on, grid - turn_on])
        nearest = KDTree(twice).query(np.column_stack([x, y])[alone])[1] % len(known)
        texel[alone] = known[nearest][:, None]
        weight[alone] = [1.0, 0.0, 0.0, 0.0]
        total = np.where(alone, 1.0, total)
    # Without any valid texel the weights stay zero, so that nothing is added to the skinning.
    weight /= np.maximum(total, 1e-9)[:, None]
    return texel, weight.astype(np.float32), alone
