"""The body in the poses that garments are modelled in."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body, align_bones, load_body
from ..geometry import TriMesh, vertex_normals

# Arms below the horizontal and legs off the vertical [degrees]; None keeps them as at rest.
POSES: dict[str, tuple[float | None, float | None]] = {
    "rest": (None, None),
    "T-pose": (0.0, 0.0),
    "A-pose, arms at 25 degrees": (25.0, None),
    "A-pose, arms at 65 degrees": (65.0, None),
    "legs apart": (None, 15.0),
    "T-pose, legs apart": (0.0, 15.0),
}
# How far the lines through the limbs go on beyond head, hands and feet [m].
_BEYOND = 1.0
_TRUNK = ("Spine1", "Spine", "LowerBack")
_LIMBS = {
    "head": ("Spine1", "Neck", "Neck1", "Head"),
    "left arm": ("Spine1", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    "right arm": ("Spine1", "RightShoulder", "RightArm", "RightForeArm", "RightHand"),
    "left leg": (*_TRUNK, "Hips", "LeftUpLeg", "LeftLeg", "LeftFoot"),
    "right leg": (*_TRUNK, "Hips", "RightUpLeg", "RightLeg", "RightFoot"),
}


class PosedBody(NamedTuple):
    """The skin of a posed body, its limbs, and the transforms of its joints.

    Attributes:
        name: Key of `POSES`.
        skin: The skin [m].
        tree: Its vertices, for nearest neighbours.
        normals: Normals of its vertices, shape [vertices, 3].
        limbs: A line from the chest through each limb and beyond it [m], each of shape
            [points, 3].
        rotations: Rotations of the joints, shape [joints, 3, 3].
        translations: Their translations [m], shape [joints, 3].
    """

    name: str
    skin: TriMesh
    tree: KDTree
    normals: Float[np.ndarray, "vertices 3"]
    limbs: dict[str, Float[np.ndarray, "points 3"]]
    rotations: Float[np.ndarray, "joints 3 3"]
    translations: Float[np.ndarray, "joints 3"]


def posed_bodies(body: Body) -> dict[str, PosedBody]:
    """The body in each of `POSES`, by name."""
    return _builtin() if body is load_body() else _compute(body)


@functools.cache
def _builtin() -> dict[str, PosedBody]:
    return _compute(load_body())


def _compute(body: Body) -> dict[str, PosedBody]:
    rest = body.rest_vertices(body.default_shape())
    heads, tails = (np.asarray(x, np.float64) for x in body.joint_positions(rest))
    mesh = body.rest_mesh()
    x = np.asarray(rest, np.float64)[:NUM_BODY_VERTICES]
    weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    out = {}
    for name, (arms, legs) in POSES.items():
        rotations, translations = np.tile(np.eye(3), (len(heads), 1, 1)), np.zeros((len(heads), 3))
        skin = mesh
        if name != "rest":
            local = jnp.asarray(align_bones(body, _targets(arms, legs)), jnp.float32)
            root = jnp.asarray(heads[0], jnp.float32)
            rotations, translations = (
                np.asarray(a, np.float64) for a in body.transforms(rest, local, root)
            )
            blend = np.einsum("vj,jab->vab", weights, rotations)
            moved = np.einsum("vab,vb->va", blend, x) + weights @ translations
            skin = mesh.replace(vertices=jnp.asarray(moved, jnp.float32))
        limbs = _limbs(
            body, *(np.einsum("jab,jb->ja", rotations, a) + translations for a in (heads, tails))
        )
        normals = vertex_normals(np.asarray(skin.vertices, np.float64), np.asarray(skin.faces))
        tree = KDTree(np.asarray(skin.vertices))
        out[name] = PosedBody(name, skin, tree, normals, limbs, rotations, translations)
    return out


def _targets(arms: float | None, legs: float | None) -> dict[str, Float[np.ndarray, "3"]]:
    """Directions of the bones of arms and legs."""
    out = {}
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        if arms is not None:
            a = np.radians(arms)
            along = np.array([sign * np.cos(a), -np.sin(a), 0.0])
            out |= {f"{side}Arm": along, f"{side}ForeArm": along}
        if legs is not None:
            a = np.radians(legs)
            along = np.array([sign * np.sin(a), -np.cos(a), 0.0])
            out |= {f"{side}UpLeg": along, f"{side}Leg": along}
    return out


def _limbs(
    body: Body, heads: Float[np.ndarray, "joints 3"], tails: Float[np.ndarray, "joints 3"]
) -> dict[str, Float[np.ndarray, "points 3"]]:
    """Lines through the limbs, from the chest on."""
    out = {}
    for limb, names in _LIMBS.items():
        at = [body.joint(n) for n in names]
        # Legs go on along the shin: a foot points forwards.
        line = [*heads[at]] if limb.endswith("leg") else [*heads[at], tails[at[-1]]]
        along = line[-1] - line[-2]
        out[limb] = np.stack([*line, line[-1] + _BEYOND * along / np.linalg.norm(along)])
    return out
