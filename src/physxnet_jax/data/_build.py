"""Building a dataset: every action, every template, through the simulator."""

import pathlib
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from ..garment import TEMPLATES, Template, template
from ..motion import Motion, animate
from ..simulation import XPBD, PreparedScene, Scene, prepare_scene, simulate_batch
from ._protocol import Action, load_action
from ._store import write_action, write_offsets


def build_dataset(
    root: str | pathlib.Path,
    folder: str | pathlib.Path,
    actions: list[Action],
    *,
    templates: tuple[Template, ...] = TEMPLATES,
    solver: XPBD | None = None,
    report: Callable[[str, int, int], None] | None = None,
) -> int:
    """Simulates actions and stores the cloth relative to its skinning.

    What is already there is kept, so a build that was stopped goes on where it was.

    Args:
        root: Where the dataset goes.
        folder: Where the motion files lie.
        actions: What to simulate.
        templates: Garments.
        solver: Settings of the solver.
        report: Called with a text, jobs done and jobs in all.

    Returns:
        Number of garments simulated now.
    """
    root = pathlib.Path(root)
    solver = XPBD() if solver is None else solver
    jobs = [(t, a) for t in templates for a in actions]
    done = 0
    prepared: tuple[str, PreparedScene] | None = None
    for k, (name, action) in enumerate(jobs):
        target = root / action.slug
        if report is not None:
            report(f"{action.name}, {name}", k, len(jobs))
        if (target / name / "meta.json").is_file():
            continue
        motion = load_action(folder, action)
        write_action(target, motion, action.split)
        if prepared is None or prepared[0] != name:
            prepared = (name, prepare_scene(Scene((template(name),))))
        scene = prepared[1]
        rollout = simulate_batch(scene, [motion], solver=solver)[0]
        offsets = rollout.positions[0] - skinned_cloth(scene, motion)
        worst = {key: float(np.max(v)) for key, v in rollout.diagnostics.items() if key != "finite"}
        if not np.isfinite(offsets).all() or np.abs(offsets).max() > 3.0:
            # It stays on record as failed; one explosion doesn't stop a build.
            offsets = np.zeros_like(offsets)
            failed = True
        else:
            failed = not rollout.finite.all()
        write_offsets(
            target,
            name,
            offsets,
            {
                "engine": "physxnet_jax XPBD",
                "substeps": solver.substeps,
                "queries": solver.queries,
                "fps": motion.fps,
                "finite": not failed,
                "worst": worst,
            },
        )
        done += 1
    if report is not None:
        report("done", len(jobs), len(jobs))
    return done


def skinned_cloth(scene: PreparedScene, motion: Motion) -> np.ndarray:
    """Linear blend skinning of a scene's cloth [m], frame by frame."""
    a = scene.assembly
    moved = animate(
        a.body,
        jnp.asarray(a.rest_body.astype(np.float32)),
        jnp.asarray(a.rest.astype(np.float32)),
        jnp.asarray(a.weights.astype(np.float32)),
        motion,
    )
    return np.asarray(moved)
