"""The example of recovering motion, where its answer is known."""

import pathlib
import runpy

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.dressing import Inference, make_dresser
from physxnet_jax.motion import load_motion

MADE = runpy.run_path(str(pathlib.Path(__file__).parents[2] / "experiments/recover_motion.py"))


@pytest.mark.release
def test_pose_is_recovered_from_its_cloth():
    dresser = make_dresser(["bottom"], inference=Inference(collisions=False))
    walk = load_motion("walk", fps=30.0)
    true = walk.rotations[10:12], walk.root[10:12]
    layer = MADE["skinning_layer"](dresser)
    target = jax.jit(layer)(*true)
    held = tuple(jnp.broadcast_to(x[:1], x.shape) for x in (walk.rotations[:2], walk.root[:2]))
    away = []
    found = MADE["recover"](
        layer, target, *held, steps=60, rate=0.05, report=lambda _, mm: away.append(mm)
    )
    assert len(away) == 60 and away[-1] < 0.2 * away[0]
    # Knees and ankles: several joints may share a turn.
    heads = dresser.body.joint_positions(dresser.rest)[0]
    joints = np.array([dresser.body.joint(n) for n in ("LeftLeg", "RightLeg", "RightFoot")])

    def places(q, p):
        world, shift = dresser.body.transforms(dresser.rest, q, p)
        return (jnp.einsum("jab,jb->ja", world, heads) + shift)[joints]

    gaps = [jax.vmap(places)(*x) - jax.vmap(places)(*true) for x in (held, found)]
    before, after = (float(jnp.linalg.norm(g, axis=2).max()) for g in gaps)
    assert before > 0.1 and after < 0.1 * before
