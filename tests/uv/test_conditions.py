"""Maps of a garment: looser cloth lies farther off, ends are seen, fabrics differ."""

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import refine_garment, tailor, template
from physxnet_jax.uv import CONDITIONS, bind, condition_maps, make_atlas


@pytest.fixture(scope="module")
def seen(body):
    """Maps of a garment by channel, at the covered texels of both charts."""
    atlas = make_atlas(64, skirt=True)
    rest = body.rest_vertices(body.default_shape())
    every = jnp.ones(atlas.num_texels, bool)

    def one(garment):
        binding = bind(garment, atlas=atlas, valid=every)
        maps = np.asarray(condition_maps(atlas, body, rest, garment, binding))
        assert maps.shape == (96, 64, len(CONDITIONS)) and np.isfinite(maps).all()
        out = dict(zip(CONDITIONS, np.moveaxis(maps, -1, 0), strict=True))
        assert set(np.unique(out["covered"]).round(6)) <= {0.0, 1.0}
        for name in CONDITIONS:
            assert (out[name][out["covered"] == 0.0] == 0.0).all(), name
        return out

    return one


@pytest.mark.release
def test_ease_is_seen_as_distance_and_area(seen):
    tight, loose = (seen(tailor("tee", ease=e)) for e in (0.05, 0.25))
    both = (tight["covered"] > 0) & (loose["covered"] > 0)
    assert both.sum() > 600
    # A circumference that is 20 cm longer has a radius that is 3 cm larger.
    more = loose["distance to the skin"][both] - tight["distance to the skin"][both]
    assert 0.15 < more.mean() < 0.4
    assert (loose["cloth over skin"][both] - tight["cloth over skin"][both]).mean() > 0.04


@pytest.mark.release
def test_flare_is_seen_on_the_chart_of_skirts(seen):
    narrow, wide = (seen(tailor(kind)) for kind in ("pencil-skirt", "full-skirt"))
    low = np.zeros((96, 64), bool)
    low[80:] = True
    both = low & (narrow["covered"] > 0) & (wide["covered"] > 0)
    assert both.sum() > 200
    assert (wide["cloth over skin"][both] - narrow["cloth over skin"][both]).min() > 0.2
    assert (narrow["covered"][:24] == 0).all(), "a skirt has no sleeves"


@pytest.mark.release
def test_borders_are_seen(seen):
    border = seen(tailor("shirt"))["distance to the border"]
    covered = seen(tailor("shirt"))["covered"] > 0
    assert border[covered].min() < 0.05 and border.max() == 1.0
    # The cuffs lie at the left and right ends of the chart, the middle of the back far from all.
    assert 0.2 < border[covered].mean() < 0.9


@pytest.mark.release
def test_cotton_is_zero_and_other_fabrics_are_not(seen):
    names = ("bending", "stretch", "density", "friction")
    plain, silk = seen(tailor("shirt")), seen(tailor("shirt", fabric="silk"))
    assert all((plain[n] == 0.0).all() for n in names)
    there = silk["covered"] > 0
    assert np.ptp(silk["bending"][there]) < 1e-5
    np.testing.assert_allclose(silk["bending"][there], -1.0, atol=1e-5)
    assert silk["density"][there].max() < -0.3 and silk["stretch"][there].min() > 0.2
    for same in ("covered", "distance to the skin", "cloth over skin"):
        np.testing.assert_allclose(silk[same], plain[same], atol=1e-6)


@pytest.mark.release
def test_a_coarse_mesh_is_seen_as_a_fine_one(seen):
    coarse = template("bottom")
    fine = seen(refine_garment(coarse, 0.015))
    found = seen(coarse)
    both = (fine["covered"] > 0) & (found["covered"] > 0)
    assert both.sum() > 0.97 * max((fine["covered"] > 0).sum(), (found["covered"] > 0).sum())
    for name in ("distance to the skin", "cloth over skin", "distance to the border"):
        assert np.abs(fine[name] - found[name])[both].mean() < 0.03, name


@pytest.mark.release
def test_garments_without_borders_and_of_templates_are_described(seen):
    for name in ("top", "bottom", "dress"):
        assert seen(template(name))["covered"].sum() > 300


@pytest.mark.release
def test_fabrics_beyond_those_learned_are_seen_as_the_nearest(body):
    """Denim is stiffer and heavier than anything learned; the control: silk is seen as it is."""
    atlas = make_atlas(64, skirt=True)
    rest = body.rest_vertices(body.default_shape())
    learned = ("cotton", "jersey", "silk")

    def row(fabric, fabrics=None):
        garment = tailor("tee", fabric=fabric)
        binding = bind(garment, atlas=atlas, valid=jnp.ones(atlas.num_texels, bool))
        maps = np.asarray(condition_maps(atlas, body, rest, garment, binding, fabrics))
        return maps[maps[..., 0] > 0][0, 4:]

    known = np.stack([row(f) for f in learned])
    assert (row("denim") > known.max(axis=0) + 0.05).all()
    np.testing.assert_allclose(row("denim", learned), known.max(axis=0), atol=1e-6)
    np.testing.assert_array_equal(row("silk", learned), row("silk"))
