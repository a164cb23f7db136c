"""One garment over another by the network: how much lies in the wrong order, and what it costs.

Command: python experiments/layers.py
         --data FOLDER (default: $PHYSXNET_DATA or ../shared)
Cost:    about four minutes on two cores beside other work.
Result:  experiments/results/layers.md, shown in docs/garments.md: on 32 frames of the punch the
         share of the outer garment's vertices beneath the inner one, and of the inner one's
         above the outer one, with each pushed out of the body alone and with the layers kept
         apart; milliseconds a frame of both, in turns.
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

from physxnet_jax.dressing import Dresser, clothe, make_dresser
from physxnet_jax.files import whole_file
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
    mesh: tuple[Float[np.ndarray, "v 3"], np.ndarray], points: Float[np.ndarray, "p 3"], above: bool
) -> float:
    """Share of points just above a mesh, or just beneath it."""
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
    return float(np.mean(over & ((height > 0) if above else (height < 0))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    parser.add_argument("--weights", default="local+relax")
    words = parser.parse_args()
    folder = pathlib.Path(words.data) / "garments"
    motion = load_motion("punch", fps=30.0)
    q, p = motion.rotations[:FRAMES], motion.root[:FRAMES]
    lines = [
        "| beneath | over it | outer beneath, % | inner above, % | kept apart: outer, % |"
        " inner, % | ms a frame | kept apart |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for pair in track(PAIRS, description="pairs"):
        jax.clear_caches()
        worn = [folder / g if g.endswith(".obj") else g for g in pair]
        kept = make_dresser(worn, weights=words.weights)
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
        cells = " | ".join(f"{100 * x:.2f}" for pair in shares for x in pair)
        times = " | ".join(f"{statistics.median(x[1:]):.1f}" for x in laps)
        names = " | ".join(w.name for w in kept.wearables)
        lines.append(f"| {names} | {cells} | {times} |")
    with whole_file(RESULT) as part:
        part.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))  # noqa: T201


def measure(dresser: Dresser, cloth: dict[str, np.ndarray]) -> tuple[float, float]:
    """Means over frames: the outer one's vertices beneath, the inner one's above."""
    inner, outer = (
        (cloth[w.name], np.asarray(f)) for w, f in zip(dresser.wearables, dresser.faces)
    )
    frames = range(0, FRAMES, EVERY)
    return (
        statistics.fmean(wrong_side((inner[0][k], inner[1]), outer[0][k], False) for k in frames),
        statistics.fmean(wrong_side((outer[0][k], outer[1]), inner[0][k], True) for k in frames),
    )


if __name__ == "__main__":
    main()
