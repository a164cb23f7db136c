"""Registration of the body to another person's mesh: pose, shape, then every vertex."""

import dataclasses
import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ..errors import MeshError
from ..geometry import (
    mesh_edges,
    quaternion_from_axis_angle,
    vertex_normals,
)
from ._align import t_pose
from ._body import NUM_BODY_VERTICES, Body, load_body
from ._kinematics import blend_rotations, linear_blend_skinning
from ._scan import Scan, nearest_facing

# Pairs of points in a step of the fit, in each direction.
_PAIRS = 800
# Steps to rank all starts and then the best few, how many of these are kept, final steps.
_TRIES, _KEPT, _STEPS = (5, 12), 4, 40
_YAWS = tuple(range(0, 360, 45))
_ALL_STEPS = 2 * len(_YAWS) * _TRIES[0] + _KEPT * _TRIES[1] + _STEPS
# Cost of a rotation [1/rad^2] relative to mean squared distances in m^2: joints that carry
# clothes rotate freely, hands and toes hardly.
_FREE, _STIFF, _LOCKED = 2e-5, 2e-4, 5e-3
_SHAPE_COST, _SCALE_COST = 2e-5, 2e-3
# Distance at which a pair's weight is a quarter [m]: initial, final and its factor per step.
_WIDE, _NARROW, _NARROWING = 0.25, 0.02, 0.85
# Largest change of a parameter in a step, and the range of shape parameters.
_LONGEST_STEP, _SHAPES = 0.4, (-0.5, 1.3)
# Share of the distance along normals in the last steps, so that surfaces may slide.
_SLIDE = 0.7
# Cost of differences along an edge in each step, relative to that of a vertex's distance. A
# displacement spreads over about the square root of it in edges, which are about 1 cm long.
_STIFFNESS = (60.0, 25.0, 10.0, 4.0, 2.0, 1.0, 1.0)
# Surfaces farther apart than this, or facing away, aren't matched [m].
_REACH = 0.12
# Largest mean distance between the surfaces of a successful registration [m].
_MAX_MEAN_DISTANCE = 0.02
# Vertices nearer than this after the last step lie on the surface [m].
_CLOSE = 0.02


@dataclasses.dataclass(frozen=True)
class Registration:
    """Positions of the body's vertices on another person's surface.

    Attributes:
        rest: Rest positions [m] of all vertices, helpers included: the other person's
            proportions in this body's rest pose, shape [all, 3].
        posed: Body vertices on the other surface, shape [13380, 3].
        face: Face of the other mesh that carries each vertex, shape [13380].
        weights: Barycentric coordinates in it, shape [13380, 3].
        distance: Distance from vertex to surface after fitting pose and shape only [m],
            shape [13380].
        sure: Whether a surface that faces the same way is nearby, shape [13380].
    """

    rest: Float[np.ndarray, "all 3"]
    posed: Float[np.ndarray, "vertices 3"]
    face: Int[np.ndarray, " vertices"]
    weights: Float[np.ndarray, "vertices 3"]
    distance: Float[np.ndarray, " vertices"]
    sure: Bool[np.ndarray, " vertices"]

    def carried(
        self,
        positions: Float[np.ndarray, "frames others 3"],
        faces: Int[np.ndarray, "faces 3"],
    ) -> Float[np.ndarray, "frames vertices 3"]:
        """Body vertices [m] that follow the other mesh through an animation."""
        corners = faces[self.face]
        out = np.zeros((len(positions), len(corners), 3), np.float32)
        for k in range(3):
            out += positions[:, corners[:, k]] * self.weights[:, k, None].astype(np.float32)
        return out


def register_body(
    vertices: Float[np.ndarray, "others 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    body: Body | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Registration:
    """Registers the body to a mesh of a standing person, of any topology.

    Pose, shape and size are fitted first (Gauss-Newton on closest points in both directions,
    from several starts). Then every vertex moves smoothly onto the surface. Hands and face
    aren't matched in detail because they carry no cloth.

    Args:
        vertices: Vertices of the person [m], Y up, limbs apart from each other.
        faces: Triangles; they face outwards.
        body: The body to register; the built-in one by default.
        progress: Called with the stage, the steps done and the total number of steps.

    Returns:
        The body on the person's surface, and its rest pose with the person's proportions.

    Raises:
        MeshError: The surfaces don't match: the mesh isn't a person, or its pose is too far
            from standing.

    References:
        Allen et al., The space of human body shapes (SIGGRAPH 2003), section 4: template
        and scan, smooth displacements. Bouaziz et al., Sparse ICP (2013): lower weights
        of far pairs.
    """
    body = load_body() if body is None else body
    target = Scan(np.asarray(vertices, np.float64), np.asarray(faces))
    fit = _Fit(body, target, progress)
    tries = [fit.run(s, _TRIES[0]) for s in fit.starts()]
    kept = sorted(tries, key=lambda found: found[1])[:_KEPT]
    best = min((fit.run(p, _TRIES[1]) for p, _ in kept), key=lambda found: found[1])[0]
    params = fit.run(best, _STEPS, last=True)[0]
    rest, world, shift = fit.posed_parts(params)
    return _project_to_surface(body, target, rest, world, shift)


class _Fit:
    """Fits pose, shape and size by Gauss-Newton on closest points."""

    def __init__(
        self,
        body: Body,
        target: Scan,
        progress: Callable[[str, int, int], None] | None,
    ) -> None:
        self.body, self.target = body, target
        self.progress, self.done = progress, 0
        self.faces = np.asarray(body.rest_mesh().faces)
        whole = body.rest_vertices(body.default_shape())
        up = np.asarray(whole)[:NUM_BODY_VERTICES, 1]
        self.height = float(np.ptp(up))
        self.hips = float(body.joint_positions(whole)[0][0, 1] - up.min())
        rng = np.random.default_rng(1)
        # Sampled by area, as a third of the vertices are in the face and hands.
        share = np.where(clothed_vertices(body), _areas(np.asarray(whole), self.faces), 0.0)
        self.body_rows = rng.choice(NUM_BODY_VERTICES, _PAIRS, replace=False, p=share / share.sum())
        self.target_rows = rng.choice(len(target.points), _PAIRS, replace=False)
        cost = []
        for name in body.joint_names:
            stiff = any(part in name for part in ("Hand", "Thumb", "Finger", "Toe", "HipJoint"))
            trunk = any(part in name for part in ("Spine", "Neck", "Head", "Back", "Shoulder"))
            cost.append(_LOCKED if stiff else _STIFF if trunk else _FREE)
        cost[0] = 0.0
        self.rotation_cost = np.repeat(cost, 3)

    def starts(self) -> list[np.ndarray]:
        """Initial parameters: A-pose and T-pose in several orientations, at the person's height."""
        t, rest = self.target.points, self.body.a_pose()
        scale = float(np.ptp(t[:, 1])) / self.height
        middle = 0.5 * (t.max(axis=0) + t.min(axis=0))
        out = []
        poses = (np.asarray(rest), np.asarray(t_pose(self.body)))
        for pose, yaw in itertools.product(poses, _YAWS):
            p = np.zeros(self.size)
            rotations = Rotation.from_quat(pose, scalar_first=True).as_rotvec()
            rotations[0] = Rotation.from_euler("Y", yaw, degrees=True).as_rotvec()
            p[: 3 * len(pose)] = rotations.ravel()
            p[-4:-1] = (middle[0], t[:, 1].min() + scale * self.hips, middle[2])
            p[-1] = np.log(scale)
            out.append(p)
        return out

    @property
    def size(self) -> int:
        """Number of parameters: rotations, shape, position of the hips, logarithm of the scale."""
        return 3 * len(self.body.parents) + len(self.body.shape_names) + 4

    def run(self, start: np.ndarray, steps: int, *, last: bool = False) -> tuple[np.ndarray, float]:
        """Returns the parameters after some steps, and the mean distance that remains [m]."""
        p, goal = start.copy(), start.copy()
        joints = 3 * len(self.body.parents)
        goal[joints:-4] = 0.0
        goal[-1] = 0.0
        cost = np.concatenate(
            [self.rotation_cost, np.full(len(self.body.shape_names), _SHAPE_COST), np.zeros(3)]
        )
        cost = np.append(cost, _SCALE_COST if last else 0.0)
        remaining = np.inf
        for k in range(steps):
            rows, points, normals, distance = self._pairs(p)
            # Far pairs are likely wrong: their weights decrease from step to step.
            scale = max(_WIDE * _NARROWING**k, _NARROW)
            weight = 1.0 / (1.0 + (distance / scale) ** 2) ** 2
            remaining = float(np.minimum(distance, 0.3).mean())
            weight = np.where(np.isfinite(distance), weight, 0.0) / len(rows)
            slide = _SLIDE if last and k > steps // 2 else 0.0
            hessian, slope = _normal_equations(
                self.body,
                jax.device_put(rows),
                jnp.asarray(points, jnp.float32),
                jnp.asarray(normals, jnp.float32),
                jnp.asarray(np.sqrt(weight), jnp.float32),
                jnp.asarray(p, jnp.float32),
                jnp.float32(slide),
            )
            hessian = np.asarray(hessian, np.float64) + np.diag(cost + 1e-7)
            slope = np.asarray(slope, np.float64) + cost * (p - goal)
            step = scipy.linalg.solve(hessian, slope, assume_a="pos")
            p = p - np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
            p[joints:-4] = np.clip(p[joints:-4], *_SHAPES)
            self.done += 1
            if self.progress is not None:
                self.progress("fitting the body", self.done, _ALL_STEPS)
        return p, remaining

    def _pairs(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Body vertices with matching points, normals and distances, in both directions."""
        x = np.asarray(_posed(self.body, jnp.asarray(p, jnp.float32))[0], np.float64)
        n = vertex_normals(x, np.asarray(self.faces))
        row, distance_to_target = self.target.nearest(x[self.body_rows], n[self.body_rows])
        points, normals = (
            self.target.points[self.target_rows],
            self.target.normals[self.target_rows],
        )
        back, distance = nearest_facing(KDTree(x), n, points, normals)
        return (
            np.concatenate([self.body_rows, back]),
            np.concatenate([self.target.points[row], points]),
            np.concatenate([self.target.normals[row], normals]),
            np.concatenate([distance_to_target, distance]),
        )

    def posed_parts(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rest vertices at the fitted scale, and the joints' transforms."""
        _, rest, world, shift = _posed(self.body, jnp.asarray(p, jnp.float32))
        return np.asarray(rest), np.asarray(world), np.asarray(shift)


def _parts(body: Body, p: Array) -> tuple[Array, Array, Array]:
    """Rest vertices and joint transforms for given parameters."""
    joints = len(body.parents)
    shape = p[3 * joints : -4]
    rest = jnp.exp(p[-1]) * body.rest_vertices(shape)
    q = quaternion_from_axis_angle(p[: 3 * joints].reshape(joints, 3))
    world, shift = body.transforms(rest, q, p[-4:-1])
    return rest, world, shift


@jax.jit
def _posed(body: Body, p: Array) -> tuple[Array, Array, Array, Array]:
    rest, world, shift = _parts(body, p)
    n = NUM_BODY_VERTICES
    return linear_blend_skinning(rest[:n], body.weights[:n], world, shift), rest, world, shift


@jax.jit
def _normal_equations(
    body: Body,
    rows: Array,
    points: Array,
    normals: Array,
    root_weight: Array,
    p: Array,
    slide: Array,
) -> tuple[Array, Array]:
    """Normal equations of weighted distances; a share ``slide`` counts along normals only."""
    # Only the vertices of the pairs and the joint markers are needed.
    used = jnp.concatenate([rows, body.joint_rows.reshape(-1)])
    count = rows.shape[0]
    small = dataclasses.replace(
        body,
        bases=body.bases[:, used],
        deltas=body.deltas[:, :, used],
        weights=body.weights[used],
        joint_rows=count + jnp.arange(body.joint_rows.size).reshape(body.joint_rows.shape),
    )

    def residual(p: Array) -> Array:
        rest, world, shift = _parts(small, p)
        x = linear_blend_skinning(rest[:count], small.weights[:count], world, shift)
        gap = x - points
        along = jnp.sum(gap * normals, axis=1, keepdims=True) * normals
        return root_weight[:, None] * ((1.0 - slide) * gap + slide * along)

    a = jax.jacfwd(residual)(p).reshape(-1, p.size)
    exact = jax.lax.Precision.HIGHEST
    return (
        jnp.matmul(a.T, a, precision=exact),
        jnp.matmul(a.T, residual(p).reshape(-1), precision=exact),
    )


def _project_to_surface(
    body: Body, target: Scan, rest: np.ndarray, world: np.ndarray, shift: np.ndarray
) -> Registration:
    """Moves every vertex onto the surface, then back into the rest pose."""
    weights = body.weights[:NUM_BODY_VERTICES]
    faces = jnp.asarray(body.rest_mesh().faces)
    x0 = np.asarray(
        linear_blend_skinning(
            jnp.asarray(rest[:NUM_BODY_VERTICES]), weights, jnp.asarray(world), jnp.asarray(shift)
        )
    )
    x = x0.copy()
    near = np.zeros(len(x))
    laplacian = _laplacian()
    for k, stiffness in enumerate(_STIFFNESS):
        n = vertex_normals(np.asarray(x), np.asarray(faces))
        row, distance = target.nearest(x, n)
        if k == 0:
            near = np.minimum(distance, 0.3)
        sure = (distance < _REACH).astype(float)
        # What protrudes is no vertex's nearest point: the surface pulls, too.
        drawn, there = _drawn(x, n, target)
        pull = sp.diags(sure + drawn + 1e-6) + stiffness * laplacian
        goal = sure[:, None] * (target.points[row] - x) + drawn[:, None] * there
        x = x + splu(pull.tocsc()).solve(goal).astype(x.dtype)
    met = float(np.mean(near[clothed_vertices(body)]))
    if met > _MAX_MEAN_DISTANCE:
        raise MeshError(
            f"The body can't be registered to this mesh: {1e3 * met:.0f} mm lie between them"
            " on average. The mesh must show a person standing with limbs apart in the"
            " first frame or in the bind pose."
        )
    n = vertex_normals(np.asarray(x), np.asarray(faces))
    face, bary, distance = target.closest_facing(x, n)
    sure = distance < _CLOSE
    posed = np.einsum("vk,vkc->vc", bary, target.vertices[target.faces[face]])
    # Vertices without a match keep their smoothed positions and follow a nearby face.
    blend = np.asarray(blend_rotations(weights, jax.device_put(world)), np.float64)
    moved = np.asarray(weights, np.float64) @ shift
    flat = np.linalg.solve(blend, (x - moved)[:, :, None])[:, :, 0]
    return Registration(
        _with_helpers(rest, flat),
        posed.astype(np.float32),
        face,
        bary,
        np.minimum(near, _REACH),
        sure,
    )


def _drawn(
    x: np.ndarray, n: np.ndarray, target: Scan
) -> tuple[Float[np.ndarray, " vertices"], Float[np.ndarray, "vertices 3"]]:
    """Vertices that are nearest to some of the surface, 1 or 0, and the way out to it [m]."""
    row, distance = nearest_facing(KDTree(x), n, target.points, target.normals)
    near = distance < _REACH
    count = np.bincount(row[near], minlength=len(x))
    way = np.zeros(x.shape)
    np.add.at(way, row[near], target.points[near] - x[row[near]])
    # Along the normal alone: vertices keep their distances from each other.
    way = n * np.einsum("vc,vc->v", n, way / np.maximum(count, 1)[:, None])[:, None]
    return (count > 0).astype(float), way


def clothed_vertices(body: Body) -> Bool[np.ndarray, " vertices"]:
    """Body vertices of trunk and limbs, without head, hands and toes."""
    bare = [
        j
        for j, name in enumerate(body.joint_names)
        if any(part in name for part in ("Hand", "Thumb", "Finger", "Toe", "Head", "Neck1"))
    ]
    return np.asarray(body.weights)[:NUM_BODY_VERTICES, bare].sum(axis=1) < 0.3


def _areas(
    vertices: Float[np.ndarray, "all 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " vertices"]:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    out = np.zeros(NUM_BODY_VERTICES)
    np.add.at(out, faces, np.linalg.norm(np.cross(b - a, c - a), axis=1)[:, None] / 6.0)
    return out


def _laplacian() -> sp.csr_matrix:
    """Graph Laplacian of the body's mesh."""
    edges = mesh_edges(np.asarray(load_body().rest_mesh().faces)).vertices
    ones = np.ones(len(edges))
    shape = (NUM_BODY_VERTICES, NUM_BODY_VERTICES)
    graph = sp.csr_matrix((ones, (edges[:, 0], edges[:, 1])), shape)
    graph = graph + graph.T
    return (sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsr()


def _with_helpers(
    rest: Float[np.ndarray, "all 3"], flat: Float[np.ndarray, "vertices 3"]
) -> Float[np.ndarray, "all 3"]:
    """Moves helper vertices with the skin around them, which may surround a limb."""
    old = rest[:NUM_BODY_VERTICES]
    others = rest[NUM_BODY_VERTICES:]
    distance, row = KDTree(old).query(others, k=48)
    width = distance[:, :1] + 0.02
    weight = np.exp(-0.5 * ((distance - distance[:, :1]) / width) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    moved = others + np.einsum("nk,nkc->nc", weight, (flat - old)[row])
    return np.concatenate([flat, moved]).astype(np.float32)
