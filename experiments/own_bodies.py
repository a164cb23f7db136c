"""Clothes on people who aren't ours: against the same clothes on the person behind them.

Command: python experiments/own_bodies.py, or with --pictures for the picture alone
Cost:    about ten minutes beside other work.
Result:  experiments/results/own_bodies.md, shown in docs/own-body.md, and its picture.
         Three persons in other triangles than the body's, bound in a T, walk and punch;
         known to the program as meshes alone.
"""

import dataclasses
import pathlib
import sys
import time

import fast_simplification
import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from physxnet_jax.body import linear_blend_skinning, load_body, t_pose
from physxnet_jax.dressing import DressedClip, dress, make_character
from physxnet_jax.files import atomic_write
from physxnet_jax.geometry import closest_points, make_mesh
from physxnet_jax.io import AnimatedMesh
from physxnet_jax.motion import body_animation, load_motion
from physxnet_jax.viewer import render_frame

RESULT = pathlib.Path(__file__).parent / "results/own_bodies.md"
PICTURE = pathlib.Path(__file__).parents[1] / "docs/own-body.png"
WEAR = ("top", "bottom", "dress")
SHOWN = (("shirt", "trousers"), ("aline",))
PEOPLE = {
    "tall man": {"gender": 1.0, "height_up": 0.7, "muscle_up": 0.5},
    "heavy woman": {"weight_up": 0.8},
    "slight man": {"gender": 1.0, "height_down": 0.5, "weight_down": 0.6},
}
CLIPS = ("walk", "punch")


def stranger(
    shape: Float[Array, " shapes"], positions: Float[np.ndarray, "frames vertices 3"]
) -> tuple[AnimatedMesh, Float[np.ndarray, "others 3"]]:
    """The same surface in 12,000 other triangles, and how it was bound."""
    body = load_body()
    rest = body.rest_vertices(shape)
    world, shift = body.transforms(rest, t_pose(body, shape), jnp.asarray([0.0, 1.0, 0.0]))
    count = positions.shape[1]
    bind = np.asarray(linear_blend_skinning(rest[:count], body.weights[:count], world, shift))
    faces = np.array(body.rest_mesh().faces)
    vertices, triangles = fast_simplification.simplify(np.array(bind), faces, target_count=12_000)
    vertices = vertices.astype(np.float32)
    foot = closest_points(make_mesh(bind, faces), jnp.asarray(vertices))
    x = positions[:, faces[np.asarray(foot.face)]]
    moved = np.einsum("vk,fvkc->fvc", np.asarray(foot.weights), x)
    return AnimatedMesh("body", moved, _int32(triangles)), vertices


def _int32(faces: np.ndarray) -> Int[np.ndarray, "faces 3"]:
    return faces.astype(np.int32)


def errors(a: DressedClip, b: DressedClip) -> list[float]:
    """RMSE between garments [mm]."""
    pairs = zip(a.garments, b.garments, strict=True)
    gaps = [((x.positions - y.positions) ** 2).sum(axis=2).mean() for x, y in pairs]
    return [1e3 * float(np.sqrt(g)) for g in gaps]


def main() -> None:
    body = load_body()
    lines = [
        "| person | motion | apart by shape and pose, mm | laid on in, s"
        " | top, mm | bottom, mm | dress, mm | on the built-in shape, mm |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, words in PEOPLE.items():
        shape = body.shape(**words)
        for clip in CLIPS:
            motion = load_motion(clip, fps=30.0, shape=shape)
            mesh, bind = stranger(shape, np.asarray(body_animation(body, motion, shape)))
            began = time.perf_counter()
            person = make_character(mesh, 30.0, bind=bind)
            spent = time.perf_counter() - began
            worn = dress(person, WEAR, method="network")
            true = dress(motion, WEAR, method="network", shape=shape)
            other = dress(motion, WEAR, method="network")
            found, control = errors(worn, true), errors(other, true)
            cells = " | ".join(f"{e:.1f}" for e in found)
            beside = " / ".join(f"{e:.0f}" for e in control)
            lines.append(
                f"| {name} | {clip} | {1e3 * person.apart:.1f} | {spent:.0f} | {cells} | {beside} |"
            )
            print(lines[-1])  # noqa: T201
    with atomic_write(RESULT) as part:
        part.write_text("\n".join(lines) + "\n")


def draw() -> None:
    """The same people in tailored clothes, guided, in the middle of the punch."""
    body, pictures = load_body(), []
    for words in PEOPLE.values():
        shape = body.shape(**words)
        motion = load_motion("punch", fps=30.0, shape=shape)
        middle = motion.num_frames // 2
        mesh, bind = stranger(shape, np.asarray(body_animation(body, motion, shape)))
        person = make_character(mesh, 30.0, bind=bind)
        for wear in SHOWN:
            clip = dress(person, wear, frames=middle + 1)
            last = [dataclasses.replace(m, positions=m.positions[middle:]) for m in clip.meshes]
            pictures.append(render_frame(last, 0, size=(260, 400)))
    with atomic_write(PICTURE) as part:
        iio.imwrite(part, np.concatenate(pictures, axis=1), extension=".png")


if __name__ == "__main__":
    if "--pictures" not in sys.argv[1:]:
        main()
    draw()
