"""Inverse problems: a fabric found from a clip of its cloth, a cut found from a mesh.

Command: python experiments/inverse.py
         --parts fabric cut (default), --weights base (default)
Cost:    under three minutes a part on two cores, compilation included.
Result:  experiments/results/inverse.json and .md.
         fabric: stretch and bending of a swatch that falls from level, from 20 frames of its
         simulated vertices, by Levenberg and Marquardt through the simulation, from starts ten
         times off. On a moving body, and with fine steps, such a search fails within a frame: the
         smallest buckle grows faster than the fabric acts.
         cut: ease and length of a dress, from a mesh of it in a frame of a walk, by Gauss and
         Newton through the tailor and the network, with slopes by differences: the network sees the
         garment by its binding, which jumps from triangle to triangle. The mesh is the network's
         own, or the guided simulation's, which differs by its folds and sag. The distance is to the
         mesh, whose triangles may be any; the nearest of all steps counts.
"""

import argparse
import json
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console

from physxnet_jax.dressing import Dresser, Inference, clothe, make_dresser
from physxnet_jax.evaluation import machine
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import KINDS, square_sheet, tailor
from physxnet_jax.geometry import TriMesh, closest_points, vertex_normals
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import (
    XPBD,
    Scene,
    advance,
    make_system,
    prepare_scene,
    start_state,
)
from physxnet_jax.simulation.effects import Bend, Damping, Gravity, Pin, Stretch

RESULTS = pathlib.Path(__file__).parent / "results"
FPS = 30.0
# Fabric: frames compared, one after another, and steps of each search.
HORIZONS, STEPS = (5, 10, 20), 12
# The swatch: vertices and length of a side [m].
SIDE, SIZE = 16, 0.3
STARTS = ((10.0, 0.1), (0.1, 10.0))
# Cut: frames until the dress hangs; measures that are hidden, and those at the start.
FRAMES, ITERATIONS, STEP = 10, 5, 0.01
HIDDEN = {"ease": 0.14, "length": 1.02}
# What the mesh comes from: the model itself, or cloth that the network has never seen.
TARGETS: tuple[Literal["network", "guided"], ...] = ("network", "guided")


def levenberg(
    residual: Callable[[Array, Array], Array], weights: list[Array], start: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Least squares by Levenberg and Marquardt with Jacobians in forward mode.

    Args:
        residual: Residuals from unknowns and weights.
        weights: Weights, one after another; each search starts at the result of the one before.
        start: Unknowns at the start.
    """
    jacobian = jax.jit(jax.jacfwd(lambda x, w: (residual(x, w),) * 2, has_aux=True))
    square = jax.jit(lambda x, w: jnp.sum(residual(x, w) ** 2))
    x = start
    for w in weights:
        damping, best = 1e-2, float(square(x, w))
        for _ in range(STEPS):
            slopes, r = jacobian(x, w)
            normal, slope = slopes.T @ slopes, slopes.T @ r
            step = jnp.zeros_like(x)
            for _ in range(6):
                scaled = normal + damping * jnp.diag(jnp.diag(normal) + 1e-12)
                step = jnp.clip(jnp.linalg.solve(scaled, slope), -1.0, 1.0)
                there = float(square(x - step, w))
                if there < best:
                    x, best, damping = x - step, there, 0.3 * damping
                    break
                damping *= 4.0
            else:
                break
            if float(jnp.abs(step).max()) < 1e-3:
                break
    return x


def fabric(console: Console, weights: str) -> Iterator[dict]:
    """Stretch and bending of a swatch that falls from level, clamped along a side."""
    del weights
    swatch = square_sheet(SIDE, SIZE, pinned=np.arange(2 * SIDE))
    # Two steps a frame of backward Euler damp the buckling that makes finer ones chaotic.
    solver, last = XPBD(2, 1, order=1), HORIZONS[-1]
    effects = (Gravity(), Damping(), Stretch(), Bend(), Pin())
    system = make_system(prepare_scene(Scene((swatch,), effects)), solver)
    still = load_motion("walk", fps=FPS)
    q, p = (jnp.repeat(x[None, :1], last + 1, axis=0) for x in (still.rotations, still.root))
    start_place = jnp.asarray(swatch.mesh.vertices)[:, :, None]

    def clip(log_factors: Float[Array, " 2"]) -> Array:
        stretch, bend = jnp.exp(log_factors)
        changed = system.rescaled(stretch=stretch, bend=bend)
        state = start_state(changed, start_place, solver=solver, fps=FPS)
        return advance(changed, state, q, p, solver=solver, fps=FPS)[1]

    seen = jax.jit(clip)(jnp.zeros(2))

    def residual(log_factors: Array, frames: Float[Array, " later"]) -> Array:
        # In millimetres, frame by frame.
        return (1e3 * frames[:, None, None, None] * (clip(log_factors) - seen)).reshape(-1)

    horizons = [(jnp.arange(last) < n).astype(jnp.float32) for n in HORIZONS]
    for start in STARTS:
        began = time.perf_counter()
        found = jnp.exp(levenberg(residual, horizons, jnp.log(jnp.asarray(start))))
        stretch, bend = (float(v) for v in found)
        console.print(f"  from {start}: {stretch:.3f}, {bend:.3f}", highlight=False)
        yield {
            "part": "fabric",
            "start_stretch": start[0],
            "start_bend": start[1],
            "stretch": stretch,
            "bend": bend,
            "seconds": time.perf_counter() - began,
        }


def cut(console: Console, weights: str) -> Iterator[dict]:
    """Ease and length of a dress from a mesh of it."""
    walk = load_motion("walk", fps=FPS)
    q, p = walk.rotations[:FRAMES], walk.root[:FRAMES]
    start = np.asarray([KINDS["aline"].ranges[name].default for name in HIDDEN])
    hidden = np.asarray(list(HIDDEN.values()))
    worn = jax.jit(lambda d: clothe(d, q, p, FPS)["aline"][-1])

    def dress_of(method: Literal["network", "guided"], values: np.ndarray) -> tuple[Array, Dresser]:
        garment = tailor("aline", **cast(Any, dict(zip(HIDDEN, values.tolist(), strict=True))))
        plain = Inference(weights=weights, strain_iterations=0, collisions=False)
        dresser = make_dresser([garment], method=method, inference=plain)
        return worn(dresser), dresser

    for method in TARGETS:
        began, values, best = time.perf_counter(), start, (np.inf, start)
        seen, dresser = dress_of(method, hidden)
        target = TriMesh(seen, dresser.faces[0])
        normals = vertex_normals(target.vertices, target.faces)
        hem = dresser.garments[0].loops["hem"].reshape(-1)
        for _ in range(ITERATIONS):
            x, _ = dress_of("network", values)
            # By differences: what the network sees of the garment changes as well, by its binding.
            ahead = [dress_of("network", values + way)[0] for way in STEP * np.eye(len(values))]
            slopes = jnp.stack([(y - x) / STEP for y in ahead], axis=-1)
            near = closest_points(target, x)
            corners = target.faces[near.face]
            foot, n = (
                jnp.einsum("pk,pkc->pc", near.weights, v[corners])
                for v in (target.vertices, normals)
            )
            apart = jnp.sum(n * (x - foot), axis=1)
            # Across the cloth at vertices; along it at the hem, which counts as much as all others.
            below = x[hem, 1].mean() - target.vertices[hem, 1].mean()
            share = len(x) ** 0.5
            across = jnp.einsum("pc,pcm->pm", n, slopes)
            rows = jnp.concatenate([across, share * slopes[hem, 1].mean(axis=0)[None]])
            step = jnp.linalg.lstsq(rows, jnp.append(apart, share * below))[0]
            distance = 1e3 * float(jnp.sqrt(jnp.mean(apart**2)))
            console.print(f"  {1e3 * values} mm: {distance:.2f} mm apart", highlight=False)
            best = min(best, (distance, values), key=lambda found: found[0])
            values = values - np.asarray(step, np.float64)
        yield {
            "part": f"cut, mesh by {method}",
            **{f"start_{m}_mm": 1e3 * d for m, d in zip(HIDDEN, start - hidden, strict=True)},
            **{f"{m}_mm": 1e3 * d for m, d in zip(HIDDEN, best[1] - hidden, strict=True)},
            "apart_mm": best[0],
            "seconds": time.perf_counter() - began,
        }


PARTS = {"fabric": fabric, "cut": cut}


def table(rows: list[dict]) -> str:
    lines = [
        "| what | start | found | seconds |",
        "|---|---|---|---|",
    ]
    for r in rows:
        if r["part"] == "fabric":
            start = f"stretch x {r['start_stretch']:g}, bending x {r['start_bend']:g}"
            found = f"stretch x {r['stretch']:.3f}, bending x {r['bend']:.3f}"
        else:
            start = f"ease {r['start_ease_mm']:+.0f} mm, length {r['start_length_mm']:+.0f} mm"
            found = f"ease {r['ease_mm']:+.1f} mm, length {r['length_mm']:+.1f} mm"
        lines.append(f"| {r['part']} | {start} | {found} | {r['seconds']:.0f} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--weights", default="base")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "inverse.json")
    options = parser.parse_args()
    console = Console()
    stored = json.loads(options.out.read_text()) if options.out.is_file() else {"rows": []}
    rows = [r for r in stored["rows"] if r["part"].split(",")[0] not in options.parts]
    for part in options.parts:
        console.print(part)
        rows += list(PARTS[part](console, options.weights))
        write_json(options.out, {"machine": machine(), "rows": rows})
    with atomic_write(options.out.with_suffix(".md")) as file:
        file.write_text(table(rows))
    console.print(table(rows), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
