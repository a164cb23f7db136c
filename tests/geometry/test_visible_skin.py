"""Visible skin: spheres as skin and cloth, where the share is known."""

import numpy as np
import pytest

from physxnet_jax.geometry import visible_skin


def sphere(rows=40, radius=1.0):
    polar = np.linspace(0, np.pi, rows)
    turn = np.linspace(0, 2 * np.pi, 2 * rows, endpoint=False)
    a, b = np.meshgrid(polar, turn, indexing="ij")
    x = np.stack([np.sin(a) * np.sin(b), np.cos(a), np.sin(a) * np.cos(b)], axis=-1)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(2 * rows), indexing="ij")
    p, q = i * 2 * rows + j, i * 2 * rows + (j + 1) % (2 * rows)
    low = np.stack([p, p + 2 * rows, q], axis=-1).reshape(-1, 3)
    high = np.stack([q, p + 2 * rows, q + 2 * rows], axis=-1).reshape(-1, 3)
    return radius * x.reshape(-1, 3), np.concatenate([low, high])


SKIN, FACES = sphere()


@pytest.mark.release
@pytest.mark.parametrize(
    ("scale", "share"),
    [(1.02, 0.0), (0.985, 1.0), (0.9, 0.0)],
    ids=["cloth outside", "skin just outside", "cloth too deep to have been over the skin"],
)
def test_share_is_all_or_nothing_for_concentric_spheres(scale, share):
    assert visible_skin(SKIN, FACES, [(scale * SKIN, FACES)]).share == share


@pytest.mark.release
def test_share_grows_with_a_hole_that_skin_pokes_through():
    cloth = 1.02 * SKIN
    shares = []
    for width in (0.0, 0.2, 0.4):
        cap = np.arccos(np.clip(SKIN[:, 2], -1, 1)) < width
        sunk = np.where(cap[:, None], 0.985 * SKIN, cloth)
        shares.append(visible_skin(SKIN, FACES, [(sunk, FACES)]).share)
    assert shares[0] == 0.0 and shares[1] > 0.003
    # The area of a cap grows with the square of its width.
    assert shares[2] / shares[1] == pytest.approx(4.0, rel=0.25)


def test_skin_beside_an_opening_does_not_count():
    upper = FACES[SKIN[FACES][:, :, 1].mean(axis=1) > 0]
    seen = visible_skin(SKIN, FACES, [(1.02 * SKIN, upper)])
    assert seen.through == 0 and seen.covered > 10000


@pytest.mark.release
def test_only_counted_skin_counts():
    inner = [(0.985 * SKIN, FACES)]
    none = np.zeros(len(FACES), bool)
    half = SKIN[FACES][:, :, 0].mean(axis=1) > 0
    every, some = visible_skin(SKIN, FACES, inner), visible_skin(SKIN, FACES, inner, counted=half)
    assert visible_skin(SKIN, FACES, inner, counted=none).through == 0
    assert some.through == pytest.approx(every.through / 2, rel=0.05)


def test_the_side_that_faces_the_body_is_not_shown_by_skin():
    """Cloth turned inside out behind skin is what one sees under a hem."""
    assert visible_skin(SKIN, FACES, [(0.985 * SKIN, FACES[:, ::-1])]).through == 0


def test_cloth_beyond_a_thin_limb_is_not_behind_its_skin():
    """A bare arm before a shirt: the outer side of cloth follows, but outside the arm."""
    arm, beyond = 0.01 * SKIN, 0.008 * SKIN
    behind = visible_skin(arm, FACES, [(beyond - [0.0, 0.0, 0.02], FACES)], cameras=1)
    within = visible_skin(arm, FACES, [(beyond, FACES)], cameras=1)
    assert behind.through == 0 and within.through > 1000


def test_bad_numbers_are_refused():
    with pytest.raises(ValueError, match="at least 1 and 16"):
        visible_skin(SKIN, FACES, [], cameras=0)
