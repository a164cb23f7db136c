"""One garment over another by the network: how much lies in the wrong order, and what it costs.

Command: python experiments/layers.py
         --data FOLDER (default: $PHYSXNET_DATA or ../shared)
Cost:    about four minutes on two cores.
Result:  experiments/results/layers.md, shown in docs/garments.md: on 32 frames of the punch the
         share of the outer garment's vertices beneath the inner one, and of the inner one's
         above the outer one, with collisions with the body alone resolved and with the layers kept
         apart; how much of the latter is in its own place: where both were within 3 cm of each
         other at rest. The remainder is another limb's cloth. Milliseconds a frame of both, in
         turns.
"""

import argparse
import functools
import os
import pathlib
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from rich.progress import track

from physxnet_jax.dressing import Dresser, Inference, clothe, make_dresser
from physxnet_jax.files import atomic_write
from physxnet_jax.geometry import closest_points, make_mesh, vertex_normals
from physxnet_jax.motion import load_motion

RESULT = pathlib.Path(__file__).parent / "results/layers.md"
PAIRS = (
    ("top", "longsleeve.obj"),
    ("tee.obj", "top"),
    ("bottom", "pants.obj"),
    ("dress", "top"),
    ("bottom", "dress"),
)
FRAMES, EVERY, ROUNDS = 32, 8, 3
# What is farther away doesn't lie over the other garment [m].
NEAR = 0.03


def wrong_side(
    mesh: tuple[Float[np.ndarray, "v 3"], np.ndarray],
    points: Float[np.ndarray, "p 3"],
    above: bool,
    rests: tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "p 3"]],
) -> tuple[float, float]:
    """Share of points just above a mesh, or just beneath it; and of those near it at rest."""
    vertices, faces = mesh
    hit = closest_points(make_mesh(vertices, faces), jnp.asarray(points))
    corners = faces[np.asarray(hit.face)]
    blend = functools.partial(np.einsum, "pk,pkx->px", np.asarray(hit.weights))
    normals = np.asarray(vertex_normals(jnp.asarray(vertices), jnp.asarray(faces)))
    normal = blend(normals[corners])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    off = points - blend(vertices[corners])
    height, away = np.sum(off * normal, axis=1), np.linalg.norm(off, axis=1)
    # Beside a hem there is neither above nor beneath.
    over = (away < NEAR) & (np.abs(height) > 0.7 * away)
    wrong = over & ((height > 0) if above else (height < 0))
    still, own = rests
    near = np.linalg.norm(own - blend(still[corners]), axis=1) < NEAR
    return float(np.mean(wrong)), float(np.mean(wrong & near))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    parser.add_argument("--weights", default="base+relax")
    words = parser.parse_args()
    folder = pathlib.Path(words.data) / "garments"
    motion = load_motion("punch", fps=30.0)
    q, p = motion.rotations[:FRAMES], motion.root[:FRAMES]
    lines = [
        "| beneath | over it | outer beneath, % | inner above, % | kept apart: outer, % |"
        " inner, % | in place: outer, % | inner, % | ms a frame | kept apart |",
        "|---" * 10 + "|",
    ]
    for pair in track(PAIRS, description="pairs"):
        jax.clear_caches()
        worn = [folder / g if g.endswith(".obj") else g for g in pair]
        kept = make_dresser(worn, inference=Inference(weights=words.weights, strain_iterations=0))
        plain = Dresser(**{**vars(kept), "layers": ()})
        calls = [
            jax.jit(clothe, static_argnames="fps").lower(d, q, p, fps=30.0).compile()
            for d in (plain, kept)
        ]
        shares, laps = [], [[], []]
        for k in range(ROUNDS + 1):
            for which, (call, d) in enumerate(zip(calls, (plain, kept), strict=True)):
                began = time.perf_counter()
                cloth = jax.block_until_ready(call(d, q, p))
                laps[which].append(1e3 * (time.perf_counter() - began) / FRAMES)
                if k == 0:
                    shares.append(
                        measure(kept, {n: np.asarray(x) for n, x in cloth.vertices.items()})
                    )
        (before, _), (after, in_place) = shares
        cells = " | ".join(f"{100 * x:.2f}" for x in (*before, *after, *in_place))
        times = " | ".join(f"{statistics.median(x[1:]):.1f}" for x in laps)
        names = " | ".join(w.name for w in kept.worn)
        lines.append(f"| {names} | {cells} | {times} |")
    with atomic_write(RESULT) as part:
        part.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))  # noqa: T201


def measure(dresser: Dresser, cloth: dict[str, np.ndarray]) -> np.ndarray:
    """Means over frames: the outer one's vertices beneath, the inner one's above.

    In all, and where both were near each other at rest.
    """
    worn = [cloth[w.name] for w in dresser.worn]
    rests = [np.asarray(w.rest) for w in dresser.worn]
    sides = []
    for still, moved, above in ((0, 1, False), (1, 0, True)):
        faces, lay = np.asarray(dresser.faces[still]), (rests[still], rests[moved])
        frames = [
            wrong_side((worn[still][k], faces), worn[moved][k], above, lay)
            for k in range(0, FRAMES, EVERY)
        ]
        sides.append(np.mean(frames, axis=0))
    return np.stack(sides, axis=1)


if __name__ == "__main__":
    main()
