"""How much of a network's error depends on what happened before the frames that it sees.

Command: python experiments/history.py --data runs/clothes/default [--weights base]
Cost:    six minutes on one core.
Result:  experiments/results/history.json and .md: means over the test actions of the RMSE [mm] of
         skinning and of the network, in the frames of the skin; of the network less its mean error
         in that very clip, vertex by vertex; and less its mean error in the other clips. The third
         is less where cloth has come to rest elsewhere for a whole clip; if the fourth is less,
         the network has a bias of its own.
"""

import argparse
import collections
import pathlib
import statistics

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.progress import track

from physxnet_jax.body import load_body, skin_points
from physxnet_jax.data import Sequence, list_sequences, read_sequence, shape_of
from physxnet_jax.evaluation import machine, method_by_name
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.geometry import polar_rotation
from physxnet_jax.motion import clip_transforms

RESULTS = pathlib.Path(__file__).parent / "results"


@jax.jit
def posed(
    rest: Float[Array, "vertices 3"],
    skin: Float[Array, "vertices joints"],
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
) -> tuple[Float[Array, "frames vertices 3"], Float[Array, "frames vertices 3 3"]]:
    """Skinned vertices [m] and the rotations of their frames."""

    def one(x: tuple[Array, Array]) -> tuple[Array, Array]:
        points, blend = skin_points(rest, skin, *x)
        return points, polar_rotation(blend)

    return jax.lax.map(one, (rotations, translations))


def errors(
    sequence: Sequence, name: str, positions: Float[np.ndarray, "frames vertices 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of skinning and of predicted cloth in the frames of the skin [m]."""
    body, garment = load_body(), sequence.garment(name)
    rest = body.rest_vertices(shape_of(sequence.clothing(name)))
    world = (jnp.asarray(x) for x in clip_transforms(body, rest, sequence.motion))
    points, frame = (
        np.asarray(x) for x in posed(garment.rest_vertices(rest), garment.skin, *world)
    )
    truth = np.asarray(sequence.offsets[name], np.float32)

    def local(x: np.ndarray) -> np.ndarray:
        return np.einsum("fvba,fvb->fva", frame, x)

    return local(-truth), local(positions - points - truth)


def rmse(error: np.ndarray) -> float:
    """Root mean square of vertex distances [mm]."""
    return 1e3 * float(np.sqrt((error.astype(np.float64) ** 2).sum(axis=-1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", required=True)
    parser.add_argument("--weights", default="base")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "history.json")
    options = parser.parse_args()
    network = method_by_name(f"{options.weights}+relax+push")
    found: dict[str, list[tuple[str, np.ndarray, np.ndarray]]] = collections.defaultdict(list)
    for folder in track(list_sequences(options.data, "test"), "actions"):
        s = read_sequence(folder)
        for name in s.offsets:
            x = network(s.motion, s.clothing(name)).positions
            found[name].append((s.motion.name, *errors(s, name, x)))
    rows = []
    for name, clips in found.items():
        means = np.stack([e.mean(axis=0) for _, _, e in clips])
        for k, (action, skinned, e) in enumerate(clips):
            others = np.delete(means, k, axis=0).mean(axis=0)
            each = {
                "skinning": skinned,
                "network": e,
                "without its mean": e - means[k],
                "without that of the others": e - others,
            }
            rows.append(
                {"garment": name, "action": action, **{m: rmse(x) for m, x in each.items()}}
            )
    write_json(options.out, {"machine": machine(), "weights": options.weights, "rows": rows})
    columns = [c for c in rows[0] if c not in ("garment", "action")]
    lines = ["| garment | " + " | ".join(f"{c}, mm" for c in columns) + " |", "|---" * 5 + "|"]
    for name in found:
        mine = [r for r in rows if r["garment"] == name]
        values = (f"{statistics.fmean(r[c] for r in mine):.1f}" for c in columns)
        lines.append(f"| {name} | " + " | ".join(values) + " |")
    with atomic_write(options.out.with_suffix(".md")) as file:
        file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
