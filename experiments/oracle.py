"""How well could any network do? The best maps for simulated cloth, through the sampling path.

Command: python experiments/oracle.py
         --kinds shirt trousers aline (default), --actions (default: the built-in punch and spin
         and, with $PHYSXNET_DATA or ../shared, the twelve test actions), --frames 90,
         --charts body body+skirt (default), --resolutions 64 128 (default)
Cost:    a minute of simulation for each garment and two actions on two cores, kept in
         runs/oracle; seconds for everything else. Goes on where it was stopped.
Result:  experiments/results/oracle.json and .md: for each garment, action and representation the
         root mean square error [mm], wrinkle error [degrees], folds over those of the simulation
         and 99 % of strain, for maps that are found by least squares; skinning beside them.

What is measured is `Binding.sample`, with every texel of the atlas at its disposal, and the
smoothing of the representation without a skirt chart. Nothing is learned.
"""

import argparse
import dataclasses
import functools
import json
import os
import pathlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from rich.console import Console
from rich.progress import track
from scipy.sparse.linalg import LinearOperator, cg, splu

from physxnet_jax.body import load_body, skin_points
from physxnet_jax.data import load_action, read_protocol
from physxnet_jax.evaluation import fold_strength, wrinkle_error
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import Garment, tailor
from physxnet_jax.geometry import mesh_edges, polar_rotation
from physxnet_jax.models import BoundGarment, bind_garment
from physxnet_jax.motion import Motion, clip_transforms, load_motion
from physxnet_jax.simulation import (
    PreparedScene,
    Scene,
    prepare_scene,
    simulate_batch,
    standard_effects,
)
from physxnet_jax.uv import bind, make_atlas

RESULTS = pathlib.Path(__file__).parent / "results"
CACHE = pathlib.Path("runs/oracle")
SHARED = pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared"))
KINDS = ["shirt", "trousers", "aline"]
BUILT_IN = {"built-in punch": "punch", "built-in spin": "spin"}
# Frames between those that are measured.
STRIDE = 6
# Keeps texels that no vertex samples at zero, and damps nothing else [1].
DAMPING = 1e-4


def all_actions() -> list[str]:
    if not (SHARED / "mocap/ACTIONS.csv").is_file():
        return list(BUILT_IN)
    return [*BUILT_IN, *(a.name for a in read_protocol(SHARED / "mocap") if a.split == "test")]


def clip(name: str, frames: int) -> Motion:
    if name in BUILT_IN:
        m = load_motion(BUILT_IN[name], fps=30.0)
    else:
        actions = {a.name: a for a in read_protocol(SHARED / "mocap")}
        m = load_action(SHARED / "mocap", actions[name])
    return dataclasses.replace(m, rotations=m.rotations[:frames], root=m.root[:frames])


def simulated(kind: str, garment: Garment, action: str, frames: int) -> np.ndarray:
    """Cloth at the preset ``standard`` [m]; kept for the next run."""
    path = CACHE / f"{kind}-{action.replace(' ', '_')}-{frames}.npz"
    if not path.is_file():
        (out,) = simulate_batch(scene_of(kind), [clip(action, frames)])
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez(file, cloth=out.positions[0].astype(np.float32))
    cloth = np.load(path)["cloth"]
    if cloth.shape[1] != garment.num_vertices:
        raise SystemExit(f"{path}: of another version of the garment; delete it.")
    return cloth


@functools.lru_cache(maxsize=1)
def scene_of(kind: str) -> PreparedScene:
    jax.clear_caches()
    garments = (tailor(kind),)
    return prepare_scene(Scene(garments, standard_effects(garments)))


def bound(garment: Garment, charts: str, resolution: int) -> tuple[BoundGarment, int]:
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    atlas = make_atlas(resolution, skirt=charts == "body+skirt")
    every = jnp.ones(atlas.num_texels, bool)
    binding = bind(garment, atlas=atlas, valid=every)
    worn = bind_garment(body, rest, garment, binding, smooth=charts == "body")
    return worn, atlas.num_texels


def best_offsets(worn: BoundGarment, texels: int, offsets: np.ndarray) -> np.ndarray:
    """What is sampled from the maps that come nearest to offsets of shape [frames, vertices, 3]."""
    index, weight = np.asarray(worn.binding.texel), np.asarray(worn.binding.weight, np.float64)
    rows = np.repeat(np.arange(len(index)), index.shape[1])
    sampling = sp.csr_matrix((weight.ravel(), (rows, index.ravel())), (len(index), texels))
    wanted = offsets.transpose(1, 0, 2).reshape(len(index), -1).astype(np.float64)
    if worn.smoothing is None:
        normal = (sampling.T @ sampling + DAMPING * sp.eye(texels)).tocsc()
        found = sampling @ splu(normal).solve(sampling.T @ wanted)
    else:
        found = smoothed_fit(worn, sampling, wanted)
    return found.reshape(len(index), len(offsets), 3).transpose(1, 0, 2)


def smoothed_fit(worn: BoundGarment, sampling: sp.csr_matrix, wanted: np.ndarray) -> np.ndarray:
    """The same through the smoothing, which is several sparse means after one another."""
    smooth = sp.eye(len(wanted)).tocsr()
    for stencil in worn.smoothing.stencils:
        index, weight = np.asarray(stencil.index), np.asarray(stencil.weight, np.float64)
        rows = np.repeat(np.arange(len(index)), index.shape[1])
        one = sp.csr_matrix((weight.ravel(), (rows, index.ravel())), (len(index), len(index)))
        smooth = one @ smooth
    both = (smooth @ sampling).tocsr()
    size = both.shape[1]
    normal = LinearOperator((size, size), lambda m: both.T @ (both @ m) + DAMPING * m)  # pyright: ignore
    columns = [cg(normal, both.T @ column, rtol=1e-5, maxiter=200)[0] for column in wanted.T]
    return both @ np.stack(columns, axis=1)


def measured(kind: str, action: str, frames: int, charts: str, resolution: int) -> Iterator[dict]:
    garment = tailor(kind)
    cloth = simulated(kind, garment, action, frames)
    pick = np.arange(STRIDE - 1, len(cloth), STRIDE)
    cloth = cloth[pick].astype(np.float64)
    skinned, turn = posed(garment, clip(action, frames), pick)
    offsets = np.einsum("fvba,fvb->fva", turn, cloth - skinned)
    worn, texels = bound(garment, charts, resolution)
    best = skinned + np.einsum("fvab,fvb->fva", turn, best_offsets(worn, texels, offsets))
    faces = np.asarray(garment.mesh.faces)
    edges, rest = mesh_edges(faces).vertices, np.asarray(garment.mesh.vertices, np.float64)

    def lengths(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x[..., edges[:, 0], :] - x[..., edges[:, 1], :], axis=-1)

    for method, x in ((charts, best), ("skinning", skinned)):
        yield {
            "kind": kind,
            "action": action,
            "map": method,
            "resolution": 0 if method == "skinning" else resolution,
            "rmse_mm": 1e3 * float(np.sqrt(np.mean(np.sum((x - cloth) ** 2, axis=2)))),
            "wrinkle_deg": wrinkle_error(faces, x, cloth),
            "folds": fold_strength(faces, x) / fold_strength(faces, cloth),
            "strain_p99": float(np.quantile(np.abs(lengths(x) / lengths(rest) - 1.0), 0.99)),
        }


def posed(garment: Garment, motion: Motion, pick: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Skinned cloth [m] and the rotations of its moving frames, in some of the frames."""
    body = load_body()
    world, shift = clip_transforms(body, body.rest_vertices(body.default_shape()), motion)

    @jax.jit
    def one(r: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        points, blend = skin_points(garment.mesh.vertices, garment.skin, r, t)
        return points, polar_rotation(blend)

    both = [one(world[k], shift[k]) for k in pick]
    points, turns = (np.stack([np.asarray(b[i], np.float64) for b in both]) for i in (0, 1))
    return points, turns


def table(rows: list[dict]) -> str:
    lines = [
        "| garment | map | actions | RMSE, mm: mean, worst | wrinkle error, degrees: mean, worst |"
        " folds | strain, 99 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in dict.fromkeys(r["kind"] for r in rows):
        mine = [r for r in rows if r["kind"] == kind]
        for key in sorted({(r["map"] != "skinning", r["map"], r["resolution"]) for r in mine}):
            some = [r for r in mine if (r["map"], r["resolution"]) == key[1:]]
            size = f", {key[2]} x {key[2]}" if key[2] else ""
            rmse, wrinkles = ([r[k] for r in some] for k in ("rmse_mm", "wrinkle_deg"))
            lines.append(
                f"| {kind} | {key[1].replace('+', ' and ')}{size} | {len(some)} |"
                f" {np.mean(rmse):.2f}, {max(rmse):.2f} |"
                f" {np.mean(wrinkles):.1f}, {max(wrinkles):.1f} |"
                f" {np.mean([r['folds'] for r in some]):.2f} |"
                f" {np.mean([r['strain_p99'] for r in some]):.2f} |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", default=KINDS)
    parser.add_argument("--actions", nargs="+", default=all_actions())
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--charts", nargs="+", default=["body", "body+skirt"])
    parser.add_argument("--resolutions", nargs="+", type=int, default=[64, 128])
    asked = parser.parse_args()
    file = RESULTS / "oracle.json"
    rows = json.loads(file.read_text()) if file.is_file() else []
    known = {(r["kind"], r["action"], r["map"], r["resolution"]) for r in rows}
    todo = [
        (kind, action, charts, resolution)
        for kind in asked.kinds
        for action in asked.actions
        for charts in asked.charts
        for resolution in asked.resolutions
        if (kind, action, charts, resolution) not in known
    ]
    for kind, action, charts, resolution in track(todo, "maps"):
        for row in measured(kind, action, asked.frames, charts, resolution):
            key = (row["kind"], row["action"], row["map"], row["resolution"])
            if key not in known:
                known.add(key)
                rows.append(row)
        with atomic_write(file) as part:
            part.write_text(json.dumps(rows, indent=1) + "\n")
    with atomic_write(file.with_suffix(".md")) as part:
        part.write_text(table(rows))
    Console().print(table(rows), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
