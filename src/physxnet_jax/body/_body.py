"""The parametric body: shape, skeleton, skin and texture chart in one pytree."""

import dataclasses
import functools
import hashlib
import importlib.resources

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from ..errors import PhysXNetError
from ..geometry import TriMesh
from ..typing import pytree
from ._kinematics import forward_kinematics, linear_blend_skinning

ASSET = "makehuman_cc0.npz"
ASSET_SHA256 = "e44596f8c2ddb61ada92901a786f12a83f525bced7ef619f11c3f9d414774676"
NUM_BODY_VERTICES = 13380


# Shape parameters beyond which bodies degenerate.
_SHAPE_LIMITS = (-1.0, 2.0)


@pytree
@dataclasses.dataclass(frozen=True)
class Body:
    """A skinned human body (MakeHuman, CC0) with its helper geometry.

    The first 13,380 of all 19,158 vertices are the body; the others (tights, skirt,
    joint markers) follow the same shape parameters and weights.

    Attributes:
        bases: Female and male rest positions [m], A-pose, shape [2, all, 3].
        deltas: Shape displacements at parameter 1 [m], shape [2, deltas, all, 3].
        joint_rows: Eight vertices each whose means are a joint's head and tail, shape
            [joints, 2, 8].
        weights: Skinning weights of all vertices, shape [all, joints].
        quads: Body quads, shape [quads, 4].
        uv: Texture coordinates, shape [uvs, 2].
        uv_quads: Corners of the quads in ``uv``, shape [quads, 4].
        tights_quads: Quads of the helper tights, shape [tights, 4].
        skirt_quads: Quads of the helper skirt, shape [skirt, 4].
        joint_names: Names as in the `cmu_mb` rig.
        parents: Parent of every joint, -1 for the root.
        shape_names: Names of the shape parameters: gender (0 female, 1 male), then
            one for each delta, all intended for [0, 1].
    """

    bases: Float[Array, "2 all 3"]
    deltas: Float[Array, "2 deltas all 3"]
    joint_rows: Int[Array, "joints 2 8"]
    weights: Float[Array, "all joints"]
    quads: Int[Array, "quads 4"]
    uv: Float[Array, "uvs 2"]
    uv_quads: Int[Array, "quads 4"]
    tights_quads: Int[Array, "tights 4"]
    skirt_quads: Int[Array, "skirt 4"]
    joint_names: tuple[str, ...] = dataclasses.field(metadata={"static": True})
    parents: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    shape_names: tuple[str, ...] = dataclasses.field(metadata={"static": True})

    def __call__(
        self,
        shape: Float[Array, " shapes"],
        pose: Float[Array, "joints 4"],
        root: Float[Array, "3"],
    ) -> Float[Array, "vertices 3"]:
        """Body vertices of a shape in a pose.

        Args:
            shape: Shape parameters, see ``shape_names``; zeros are a young woman.
            pose: Local joint rotations, wxyz; identities are the A-pose.
            root: World position of the hips joint [m].

        Returns:
            Positions [m], shape [13380, 3].

        Example:
            >>> body = load_body()
            >>> zeros = jnp.zeros(len(body.shape_names))
            >>> body(zeros, body.a_pose(), jnp.zeros(3)).shape
            (13380, 3)

        References:
            PhysXNet, section 4.2: M_B(alpha, theta).
        """
        rest = self.rest_vertices(shape)
        rotations, translations = self.transforms(rest, pose, root)
        return linear_blend_skinning(
            rest[:NUM_BODY_VERTICES],
            self.weights[:NUM_BODY_VERTICES],
            rotations,
            translations,
        )

    def rest_vertices(self, shape: Float[Array, " shapes"]) -> Float[Array, "all 3"]:
        """Rest positions [m] of all vertices, helpers included.

        Raises:
            ValueError: The number of parameters differs from ``shape_names``.
        """
        if shape.shape != (len(self.shape_names),):
            raise ValueError(
                f"shape is {shape.shape}, but the body has {len(self.shape_names)} parameters,"
                f" {', '.join(self.shape_names)}. Use body.shape(name=value)."
            )
        return _rest_vertices(self.bases, self.deltas, shape)

    def joint_positions(
        self, rest: Float[Array, "all 3"]
    ) -> tuple[Float[Array, "joints 3"], Float[Array, "joints 3"]]:
        """Heads and tails of the bones at rest [m]."""
        return _joint_positions(rest, self.joint_rows)

    def transforms(
        self,
        rest: Float[Array, "all 3"],
        pose: Float[Array, "joints 4"],
        root: Float[Array, "3"],
    ) -> tuple[Float[Array, "joints 3 3"], Float[Array, "joints 3"]]:
        """World rotations and translations [m] of the joints, see `forward_kinematics`."""
        heads, _ = self.joint_positions(rest)
        return forward_kinematics(self.parents, heads, pose, root)

    def mesh(self, vertices: Float[Array, "vertices 3"]) -> TriMesh:
        """The body as triangles, with its texture coordinates."""
        return TriMesh(vertices, triangulate(self.quads), self.uv, triangulate(self.uv_quads))

    def rest_mesh(self, shape: Float[Array, " shapes"] | None = None) -> TriMesh:
        """The body mesh at rest (A-pose), of the default shape if none is given."""
        rest = self.rest_vertices(self.default_shape() if shape is None else shape)
        return self.mesh(rest[:NUM_BODY_VERTICES])

    def default_shape(self) -> Float[Array, " shapes"]:
        """All zeros: the young woman that garments are modelled on."""
        return jnp.zeros((len(self.shape_names),), jnp.float32)

    def shape(self, /, **values: float | int) -> Float[Array, " shapes"]:
        """Shape parameters by name.

        Raises:
            PhysXNetError: A name isn't in ``shape_names``, or a value is outside
                [-1, 2], beyond which bodies degenerate.

        Example:
            >>> load_body().shape(gender=1.0, weight_up=0.5).shape
            (9,)
        """
        unknown = set(values) - set(self.shape_names)
        if unknown:
            raise PhysXNetError(
                f"Unknown shape parameter {sorted(unknown)}; expected one of"
                f" {', '.join(self.shape_names)}."
            )
        shape = np.asarray([float(values.get(n, 0.0)) for n in self.shape_names], np.float32)
        return self.checked_shape(jnp.asarray(shape))

    def checked_shape(self, shape: Float[Array, " shapes"] | None) -> Float[Array, " shapes"]:
        """Shape parameters within their limits; the default shape if None.

        Under `jax.jit`, parameters outside them become NaN, which clears `Clothed.ok`.

        Raises:
            PhysXNetError: A value is outside [-1, 2], beyond which bodies degenerate.
        """
        if shape is None:
            return self.default_shape()
        low, high = _SHAPE_LIMITS
        if isinstance(shape, Tracer):
            return jnp.where((shape >= low) & (shape <= high), shape, jnp.nan)
        for name, value in zip(self.shape_names, np.asarray(shape).reshape(-1), strict=False):
            if not low <= value <= high:
                raise PhysXNetError(
                    f"{name}={value:g}: expected a number from 0 to 1 (limits: {low:g} and"
                    f" {high:g})."
                )
        return shape

    def a_pose(self) -> Float[Array, "joints 4"]:
        """The rest pose: arms 45 degrees down. All identities."""
        one = np.zeros((len(self.parents), 4), dtype=np.float32)
        one[:, 0] = 1.0
        return jnp.asarray(one)

    def with_rest(self, rest: Float[Array, "all 3"]) -> "Body":
        """The body with fixed rest vertices [m], helpers included, for every shape."""
        return dataclasses.replace(
            self, bases=jnp.stack([rest, rest]), deltas=jnp.zeros_like(self.deltas)
        )

    def joint(self, name: str) -> int:
        """Index of a joint by name."""
        return self.joint_names.index(name)


# Compiled as a whole; otherwise every operation would be compiled separately.
@jax.jit
def _rest_vertices(bases: Array, deltas: Array, shape: Array) -> Array:
    male = shape[0]
    base = bases[0] + male * (bases[1] - bases[0])
    mixed = deltas[0] + male * (deltas[1] - deltas[0])
    return base + jnp.tensordot(shape[1:], mixed, axes=1, precision=jax.lax.Precision.HIGHEST)


@jax.jit
def _joint_positions(rest: Array, rows: Array) -> tuple[Array, Array]:
    ends = jnp.mean(rest[rows], axis=2)
    return ends[:, 0], ends[:, 1]


@jax.jit
def triangulate(quads: Int[Array, "quads 4"]) -> Int[Array, "triangles 3"]:
    """Splits each quad into two triangles along the diagonal from its first corner."""
    pairs = jnp.stack([quads[:, jnp.array([0, 1, 2])], quads[:, jnp.array([0, 2, 3])]], 1)
    return pairs.reshape(-1, 3)


@functools.cache
def load_body() -> Body:
    """Loads the built-in body.

    Returns:
        The MakeHuman base mesh (CC0) with the `cmu_mb` rig, 31 joints.

    Raises:
        PhysXNetError: The asset in the package is damaged (its hash differs).

    References:
        MakeHuman base mesh hm08, CC0 1.0; see `body/assets/PROVENANCE.md`.
    """
    resource = importlib.resources.files(__name__.rpartition(".")[0]) / "assets" / ASSET
    blob = resource.read_bytes()
    digest = hashlib.sha256(blob).hexdigest()
    if digest != ASSET_SHA256:
        raise PhysXNetError(
            f"{ASSET}: sha256 is {digest}, expected {ASSET_SHA256}. Reinstall the package."
        )
    with importlib.resources.as_file(resource) as path, np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    # Cached arrays mustn't be tracers of an enclosing transformation.
    with jax.ensure_compile_time_eval():
        return _from_arrays(arrays)


def _from_arrays(data: dict[str, np.ndarray]) -> Body:
    quantum = float(data["quantum"])

    def metres(x: np.ndarray) -> Array:
        return jax.device_put((x * quantum).astype(np.float32))

    top = data["weights"].astype(np.float64)
    top /= top.sum(axis=1, keepdims=True)
    weights = np.zeros((len(top), len(data["parents"])))
    np.add.at(weights, (np.arange(len(top))[:, None], data["weight_joints"]), top)

    def index(name: str) -> Array:
        return jax.device_put(data[name].astype(np.int32))

    return Body(
        bases=metres(data["bases"]),
        deltas=metres(data["deltas"]),
        joint_rows=index("joint_rows"),
        weights=jax.device_put(weights.astype(np.float32)),
        quads=index("body_quads"),
        uv=jax.device_put(data["uv"]),
        uv_quads=index("body_uv_quads"),
        tights_quads=index("tights_quads"),
        skirt_quads=index("skirt_quads"),
        joint_names=tuple(str(n) for n in data["joint_names"]),
        parents=tuple(int(p) for p in data["parents"]),
        shape_names=("gender", *(str(n) for n in data["delta_names"])),
    )
