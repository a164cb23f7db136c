"""Sample points on large triangles: spacing, conservation, and skin that stays covered."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.evaluation import surface_faults
from physxnet_jax.garment import load_garment, square_sheet
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import STANDARD, XPBD, Scene, prepare_scene, simulate_batch
from physxnet_jax.simulation.effects import BodyContact
from physxnet_jax.simulation.effects._samples import sample_faces


@pytest.mark.parametrize("spacing", [0.03, 0.05, 0.2])
def test_samples_and_vertices_are_nowhere_farther_apart_than_the_spacing(spacing):
    g = square_sheet(3, 0.2)
    x, faces = np.asarray(g.mesh.vertices, np.float64), np.asarray(g.mesh.faces)
    samples = sample_faces(x, faces, spacing)
    points = np.asarray(samples.extend(jnp.asarray(x, jnp.float32)[:, :, None]))[..., 0]
    rng = np.random.default_rng(0)
    w = rng.dirichlet(np.ones(3), size=(len(faces), 50))
    inside = np.einsum("fnk,fkc->fnc", w, x[faces]).reshape(-1, 3)
    nearest = np.linalg.norm(inside[:, None] - points[None], axis=2).min(axis=1)
    assert nearest.max() <= spacing / np.sqrt(3) + 1e-6 or spacing == 0.2
    assert (samples.count == 0) == (spacing == 0.2)


def test_moves_of_all_samples_by_one_vector_move_the_vertices_by_no_more():
    g = square_sheet(3, 0.2)
    x = jnp.zeros((9, 3, 2))
    samples = sample_faces(np.asarray(g.mesh.vertices, np.float64), np.asarray(g.mesh.faces), 0.05)
    one = jnp.ones((samples.count, 3, 2)) * jnp.asarray([0.01, 0.02])[None, None]
    acts = jnp.ones((samples.count, 1, 2))
    free = jnp.ones((9, 1)).at[4].set(0.0)
    moved = np.asarray(samples.push(x, one, acts, free))
    assert (moved[4] == 0).all(), "held"
    assert moved.max() <= 0.02 * 1.5 and np.delete(moved[..., 0], 4, axis=0).min() >= 0.005
    still = np.asarray(samples.push(x, one, 0.0 * acts, free))
    assert (still == 0).all(), "samples that don't act move nothing"


@pytest.mark.nightly
def test_skin_does_not_show_through_large_triangles(data_dir):
    garment, _ = load_garment(data_dir / "garments" / "helper_tights.obj")
    motion = load_motion("punch", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:20], root=motion.root[:20])
    shares = []
    for spacing in (BodyContact().sample_spacing, 10.0):
        effects = tuple(
            BodyContact(sample_spacing=spacing) if isinstance(e, BodyContact) else e
            for e in STANDARD
        )
        scene = prepare_scene(Scene((garment,), effects))
        (out,) = simulate_batch(scene, [motion], solver=XPBD(32, 1))
        seen = surface_faults(
            scene.assembly, motion, out.positions[0], frames=np.array([0, 10, 19])
        )
        shares.append(seen.visible_skin)
    assert shares[0] < 3e-4 < 1.5e-3 < shares[1], shares
