"""All garments of a scene as one set of particles and triangles."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body
from ..garment import Garment, holding_loops


@dataclasses.dataclass(frozen=True)
class Assembly:
    """Input of `Effect.prepare`: host arrays, built once per scene.

    Attributes:
        body: The body that wears the garments.
        rest_body: Rest positions of all body vertices [m], shape [all, 3].
        rest: Rest positions of cloth vertices [m], shape [vertices, 3].
        faces: Cloth triangles, shape [faces, 3].
        mass: Vertex masses [kg], shape [vertices].
        pinned: Vertices that follow the skin, shape [vertices].
        weights: Skinning weights of cloth vertices, shape [vertices, joints].
        thickness: Smallest gap kept to the skin [m], shape [vertices].
        friction: Coulomb coefficient [1], shape [vertices].
        stretch: Membrane stiffness of faces [N/m], shape [faces].
        bend: Bending stiffness of faces [N m], shape [faces].
        membrane: Stiffness along warp, weft and in shear [N/m], shape [faces, 3].
        density: Mass per area of faces [kg/m^2], shape [faces].
        loose: Vertices that may touch any limb (skirts), shape [vertices].
        hanging: Vertices of skirts below the hip joints, which swing, shape [vertices].
        parts: First vertex of each garment, followed by the number of vertices.
        coarse_faces: Triangles of the meshes that garments refine, shape [coarse, 3].
        bands: Edges of elastic bands, shape [bands, 2].
        holds: For each garment, the vertices of each curve that holds it up.
    """

    body: Body
    rest_body: Float[np.ndarray, "all 3"]
    rest: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    mass: Float[np.ndarray, " vertices"]
    pinned: Bool[np.ndarray, " vertices"]
    weights: Float[np.ndarray, "vertices joints"]
    thickness: Float[np.ndarray, " vertices"]
    friction: Float[np.ndarray, " vertices"]
    stretch: Float[np.ndarray, " faces"]
    bend: Float[np.ndarray, " faces"]
    membrane: Float[np.ndarray, "faces 3"]
    density: Float[np.ndarray, " faces"]
    loose: Bool[np.ndarray, " vertices"]
    hanging: Bool[np.ndarray, " vertices"]
    parts: tuple[int, ...]
    coarse_faces: Int[np.ndarray, "coarse 3"]
    bands: Int[np.ndarray, "bands 2"]
    holds: tuple[tuple[Int[np.ndarray, " _"], ...], ...]


# Friction of elastic bands, as of silicone on skin [1].
_GRIP = 1.5


def assemble(garments: tuple[Garment, ...], body: Body, shape: Float[Array, " shapes"]) -> Assembly:
    """Combines garments at rest on a body into one system."""
    rest_body = body.rest_vertices(shape)
    rest, faces, mass, pinned, weights = [], [], [], [], []
    per_vertex: dict[str, list] = {"thickness": [], "friction": []}
    per_face: dict[str, list] = {"stretch": [], "bend": [], "membrane": [], "density": []}
    loose, hanging = [], []
    heads = body.joint_positions(rest_body)[0]
    hips = float(np.mean([heads[body.joint(f"{side}UpLeg"), 1] for side in ("Left", "Right")]))
    coarse, bands = [np.zeros((0, 3), np.int64)], [np.zeros((0, 2), np.int64)]
    parts, holds = [0], []
    for g in garments:
        x = np.asarray(g.rest_vertices(rest_body), dtype=np.float64)
        f = np.asarray(g.mesh.faces)
        area = 0.5 * np.linalg.norm(
            np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]]), axis=1
        )
        m = np.zeros(len(x))
        np.add.at(m, f, (g.fabric.density * area / 3)[:, None])
        # A vertex without area still needs a mass: a thousandth of the mean.
        m = np.maximum(m, 1e-3 * max(float(m.mean()), 1e-9))
        rest.append(x)
        faces.append(f + parts[-1])
        if g.coarse_faces is not None:
            coarse.append(np.asarray(g.coarse_faces) + parts[-1])
        mass.append(m)
        pinned.append(np.asarray(g.pinned))
        weights.append(np.asarray(g.skin, dtype=np.float64))
        per_vertex["thickness"].append(np.full(len(x), g.fabric.thickness))
        friction = np.full(len(x), g.fabric.friction)
        for name in g.elastic:
            band = np.asarray(g.loops[name])
            friction[band] = max(g.fabric.friction, _GRIP)
            bands.append(band + parts[-1])
        per_vertex["friction"].append(friction)
        per_face["stretch"].append(np.full(len(f), g.fabric.stretch))
        per_face["bend"].append(np.full(len(f), g.fabric.bend))
        per_face["membrane"].append(np.tile(g.fabric.membrane, (len(f), 1)))
        per_face["density"].append(np.full(len(f), g.fabric.density))
        holds.append(tuple(c + parts[-1] for c in holding_loops(g).values()))
        loose.append(_loose_vertices(g, x, np.asarray(rest_body, np.float64)))
        low = (x[:, 1] < hips) & (g.template == "dress")
        # A piece without anything higher has nothing to hang from.
        hanging.append(low & ~low.all())
        parts.append(parts[-1] + len(x))
    cat = np.concatenate
    return Assembly(
        body,
        np.asarray(rest_body, np.float64),
        cat(rest),
        cat(faces),
        cat(mass),
        cat(pinned),
        cat(weights),
        cat(per_vertex["thickness"]),
        cat(per_vertex["friction"]),
        cat(per_face["stretch"]),
        cat(per_face["bend"]),
        cat(per_face["membrane"]),
        cat(per_face["density"]),
        cat(loose),
        cat(hanging),
        tuple(parts),
        cat(coarse),
        cat(bands),
        tuple(holds),
    )


def norm(x: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Lengths, whose gradient is zero where they are."""
    squared = jnp.sum(x * x, axis=-1)
    safe = jnp.where(squared > 0.0, squared, 1.0)
    return jnp.where(squared > 0.0, jnp.sqrt(safe), 0.0)


def vertex_masses(
    rest: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    density: Float[Array, " faces"],
) -> Float[Array, " vertices"]:
    """Masses of vertices [kg], as `assemble` has them, as a function of the rest positions."""
    a, b, c = (rest[faces[:, k]] for k in range(3))
    share = density * norm(jnp.cross(b - a, c - a)) / 6.0
    mass = jnp.zeros(len(rest), rest.dtype).at[faces].add(share[:, None])
    return jnp.maximum(mass, 1e-3 * jnp.maximum(jnp.mean(mass), 1e-9))


def float32(x: np.ndarray) -> Array:
    """Converts to a float32 device array."""
    return jax.device_put(np.asarray(x, dtype=np.float32))


# Cloth farther than this from the skin counts as loose [m].
_LOOSE_DISTANCE = 0.025


def _loose_vertices(
    garment: Garment, x: Float[np.ndarray, "vertices 3"], rest_body: Float[np.ndarray, "all 3"]
) -> Bool[np.ndarray, " vertices"]:
    """Vertices that may touch any limb: those of a skirt and those far from the skin."""
    far = KDTree(rest_body[:NUM_BODY_VERTICES]).query(x)[0] > _LOOSE_DISTANCE
    if garment.template != "dress":
        return far
    # A skirt is loose from the height at which it leaves the body down to its hem.
    top = x[far, 1].max() if far.any() else -np.inf
    return far | (x[:, 1] < top)
