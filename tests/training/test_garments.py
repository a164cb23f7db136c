"""Networks that see the garment: they learn what depends on it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from physxnet_jax.body import load_body
from physxnet_jax.data import (
    FrameStream,
    Outfit,
    Sequence,
    TemplateStreams,
    load_frames,
    make_wardrobe,
    read_entry,
)
from physxnet_jax.dressing import Inference, clothe, clothe_step, init_stream, make_dresser
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.garment import tailor
from physxnet_jax.geometry import mesh_edges, patch_shares
from physxnet_jax.models import ModelConfig, load_predictor, make_generator, save_predictor
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import elastic_tables
from physxnet_jax.training import LossInputs, TrainConfig, train
from physxnet_jax.training._garment_tables import prepare_garments
from physxnet_jax.training._problem import configured_loss
from physxnet_jax.uv import bind, make_atlas

MODEL = ModelConfig(
    resolution=64, width=4, templates=("top",), skirt_chart=True, finer=True, conditions=True
)
CONFIG = TrainConfig(
    model=MODEL, batch=8, epochs=30, learning_rate=1e-2, schedule="cosine", adversarial=False
)
TIGHT = Outfit(wear=("tee",))
LOOSE = Outfit(wear=("loose:ease=0.3",), shape=("weight_up=0.5",))
# How far the cloth of these tests stands off where it is loose [m].
OFF = 0.04


def sequence(outfit, far):
    motion = load_motion("walk", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:24], root=motion.root[:24])
    (garment,) = outfit.garments().values()
    offsets = np.zeros((24, garment.num_vertices, 3), np.float32)
    offsets[..., 1] = far
    meta = {"top": {"engine": "physxnet", "finite": True, "worst": {}}}
    return Sequence(f"walk {far}", "train", motion, {"top": offsets}, meta, outfit)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A network that saw tight cloth on its skinning and loose cloth below it."""
    folder = tmp_path_factory.mktemp("run")
    return train(CONFIG, [sequence(TIGHT, 0.0), sequence(LOOSE, -OFF)], folder)


@pytest.mark.release
def test_garments_and_persons_are_numbered_once():
    w = make_wardrobe([TIGHT, LOOSE, TIGHT, dataclasses.replace(TIGHT)], ("top", "bottom"))
    assert len(w.garments["top"]) == 2 and w.garments["bottom"] == ()
    assert [w.numbers["top", o] for o in (TIGHT, LOOSE)] == [0, 1]
    assert w.persons == ((), ("weight_up=0.5",)) and w.person(LOOSE) == 1
    assert w.num_vertices("top") == max(g.num_vertices for g in w.garments["top"])
    assert len(w.rests()) == 2


@pytest.mark.release
def test_tables_sample_as_bindings_do():
    wardrobe = make_wardrobe([TIGHT, LOOSE], ("top",))
    atlas, motion_atlas, points, persons, tables = prepare_garments(MODEL, wardrobe)
    assert (atlas.height, motion_atlas.height) == (96, 48)
    assert persons.rest.shape == (2, motion_atlas.num_texels, 3)
    assert float(jnp.abs(persons.rest[0] - points.rest).max()) == 0.0
    values = jax.random.normal(jax.random.key(0), (2, atlas.num_texels, 3))
    got = tables["top"].sample(values, jnp.asarray([0, 1]))
    for k, garment in enumerate(wardrobe.garments["top"]):
        binding = bind(garment, atlas=atlas, valid=jnp.ones(atlas.num_texels, bool))
        n = garment.num_vertices
        np.testing.assert_allclose(got[k, :n], binding.sample(values[k][None])[0], atol=1e-5)
        assert float(tables["top"].present[k].sum()) == n
    with pytest.raises(FormatError, match="no 'bottom' in the data"):
        prepare_garments(MODEL, make_wardrobe([TIGHT], ("top", "bottom")))


@pytest.mark.release
def test_means_are_those_of_patches():
    wardrobe = make_wardrobe([TIGHT, LOOSE], ("top",))
    *_, tables = prepare_garments(MODEL, wardrobe)
    table, both = tables["top"], jnp.asarray([0, 1])
    x = jax.random.normal(jax.random.key(1), (2, wardrobe.num_vertices("top"), 3))
    means, weight = table.means(x, both)
    for k, garment in enumerate(wardrobe.garments["top"]):
        mesh, n = garment.mesh, garment.num_vertices
        shares = patch_shares(np.asarray(mesh.vertices), np.asarray(mesh.faces), 0.08).toarray()
        wanted = shares.T @ np.asarray(x[k, :n]) / shares.sum(axis=0)[:, None]
        np.testing.assert_allclose(means[k, : len(wanted)], wanted, atol=1e-5)
        assert float(jnp.abs(weight[k, len(wanted) :]).sum()) == 0.0
        assert float(weight[k].sum()) == pytest.approx(n, rel=1e-4)
    flat = np.asarray(table.means(jnp.ones_like(x), both)[0])
    np.testing.assert_allclose(flat[np.asarray(weight) > 0.0], 1.0, atol=1e-5)


def test_share_of_patches_weighs_both_parts():
    def inputs():
        x = jnp.zeros((1, 2, 3))
        return LossInputs(
            maps=jnp.zeros((1, 4, 4, 3)),
            texels=x,
            target=None,
            valid=jnp.ones(2, bool),
            weight=jnp.ones(1),
            vertices=x,
            vertex_target=x + jnp.asarray([0.3, -0.3])[None, :, None],
            present=jnp.ones((1, 2)),
            edges=None,
            means=(jnp.zeros((1, 1, 3)), jnp.full((1, 1, 3), 0.1), jnp.ones((1, 1))),
            differences=(jnp.zeros((1, 1, 3)), jnp.full((1, 1, 3), -0.6), jnp.ones((1, 1))),
            elastic=jnp.full(1, 5.0),
            atlas=make_atlas(32),
        )

    for share, wanted in ((0.0, 0.3), (0.25, 0.25), (1.0, 0.1)):
        loss = configured_loss(dataclasses.replace(CONFIG, patch_share=share))
        assert float(loss(inputs())) == pytest.approx(wanted, rel=1e-5)
    both = dataclasses.replace(CONFIG, patch_share=0.25, vertex_share=1.0, edge_share=0.5)
    assert float(configured_loss(both)(inputs())) == pytest.approx(0.425, rel=1e-5)
    firm = dataclasses.replace(both, elastic_weight=0.01)
    assert float(configured_loss(firm)(inputs())) == pytest.approx(0.475, rel=1e-5)
    wrong = (
        ({"patch_share": 2.0}, "from 0 to 1"),
        ({"patch_share": 0.5}, "conditions"),
        ({"elastic_weight": 0.5}, "conditions"),
        ({"elastic_weight": 1.0, "model": MODEL, "adversarial": False, "loss": "l2"}, "loss='l1'"),
        ({"elastic_weight": -1.0, "model": MODEL, "adversarial": False}, "elastic_weight"),
    )
    for given, says in wrong:
        with pytest.raises(ValueError, match=says):
            TrainConfig(**given)


@pytest.mark.release
def test_elastic_energy_is_that_of_each_garment_on_its_person(body):
    wardrobe = make_wardrobe([TIGHT, LOOSE], ("top",))
    *_, tables = prepare_garments(MODEL, wardrobe, elastic=True)
    both, joints = jnp.asarray([1, 0]), len(body.parents)
    most = wardrobe.num_vertices("top")
    offsets = 0.01 * jax.random.normal(jax.random.key(3), (2, most, 3))
    still = jnp.broadcast_to(jnp.eye(3), (2, joints, 3, 3)), jnp.zeros((2, joints, 3))
    found = tables["top"].elastic_energy(offsets, both, *still)
    for k, outfit in enumerate((LOOSE, TIGHT)):
        (garment,) = outfit.garments().values()
        rest = garment.rest_vertices(body.rest_vertices(outfit.params()))
        (own,) = (jax.tree.map(lambda x: x[0], elastic_tables([garment], [outfit.params()])),)
        wanted = own.energy(rest + offsets[k, : garment.num_vertices]) / own.lift(0.01)
        np.testing.assert_allclose(found[k], wanted, rtol=1e-3)
    # A person who has turned and gone elsewhere has the same.
    turn = jnp.asarray([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    away = (
        jnp.broadcast_to(turn, still[0].shape),
        still[1] + jnp.asarray([3.0, 0.0, 1.0])[None, None],
    )
    np.testing.assert_allclose(tables["top"].elastic_energy(offsets, both, *away), found, rtol=2e-3)
    idle = dataclasses.replace(tables["top"], elastic=None)
    assert idle.elastic_energy(offsets, both, *still) is None


@pytest.mark.nightly
def test_training_goes_on_from_weights_and_lowers_their_elastic_energy(learned, tmp_path):
    save_predictor(tmp_path / "w", learned, name="w")
    data = [sequence(TIGHT, 0.0), sequence(LOOSE, -OFF)]
    onward = dataclasses.replace(
        CONFIG, start=str(tmp_path / "w"), epochs=8, learning_rate=1e-2, elastic_weight=2.0
    )
    energies = {}
    for name, config in {
        "without": dataclasses.replace(onward, elastic_weight=0.0),
        "with": onward,
    }.items():
        found = train(config, data, tmp_path / name)
        assert float(found.normalisation.offset["top"]) == float(
            learned.normalisation.offset["top"]
        )
        energies[name] = energy_of(found)
    # What skinning alone does to the cloth is no choice of the network's.
    before, skinned = energy_of(learned), energy_of(None)
    assert energies["with"] - skinned < 0.6 * (energies["without"] - skinned)
    # Without, it hardly changes: the run went on from the weights.
    assert energies["without"] == pytest.approx(before, rel=0.1)
    other = dataclasses.replace(onward, model=dataclasses.replace(MODEL, width=8))
    with pytest.raises(PhysXNetError, match="another model"):
        train(other, data, tmp_path / "other")


@pytest.mark.release
def test_decoders_that_are_not_learned_stay(learned, tmp_path):
    model = dataclasses.replace(MODEL, templates=("top", "bottom"))
    graph, state = nnx.split(make_generator(model, seed=3))
    points, scales = learned.texel_points, learned.normalisation
    before = dataclasses.replace(
        learned,
        config=model,
        graph=graph,
        state=state,
        texel_points=dataclasses.replace(
            points, valid=dict.fromkeys(model.templates, points.valid["top"])
        ),
        normalisation=dataclasses.replace(
            scales, offset=dict.fromkeys(model.templates, scales.offset["top"])
        ),
    )
    save_predictor(tmp_path / "w", before, name="w")
    config = dataclasses.replace(
        CONFIG,
        model=model,
        start=str(tmp_path / "w"),
        learned=("top",),
        epochs=0.3,
        elastic_weight=1e-4,
    )
    assert config.templates == ("top",)
    steps = []
    after = train(
        config,
        [sequence(TIGHT, 0.0), sequence(LOOSE, -OFF)],
        tmp_path / "run",
        report=lambda _, total, __: steps.append(total),
    )
    assert steps == [2], "0.3 of the six steps of an epoch"
    was, now = (
        dict(nnx.to_flat_state(p.state)) for p in (load_predictor(str(tmp_path / "w")), after)
    )
    changed = {k for k in was if not np.array_equal(was[k][...], now[k][...])}
    assert changed == {k for k in was if k[:2] == ("decoders", "top") and not is_statistic(was[k])}
    assert set(after.texel_points.valid) == set(model.templates)
    # The finished run gives what lies between; nothing is learned for it.
    steps.clear()
    between = train(
        dataclasses.replace(config, blend=0.25),
        [sequence(TIGHT, 0.0), sequence(LOOSE, -OFF)],
        tmp_path / "run",
        report=lambda _, total, __: steps.append(total),
    )
    assert not steps
    for k, x in nnx.to_flat_state(between.state):
        a, b = np.asarray(was[k][...]), np.asarray(now[k][...])
        if k in changed:
            np.testing.assert_allclose(x[...], 0.75 * a + 0.25 * b, rtol=1e-5, atol=1e-7)
        else:
            np.testing.assert_array_equal(x[...], a)
    for given in ({"learned": ("dress",)}, {"start": ""}):
        with pytest.raises(ValueError, match="learned is"):
            dataclasses.replace(config, **given)
    for given in ({"blend": 0.0}, {"blend": 1.5}, {"blend": 0.5, "learned": ()}):
        with pytest.raises(ValueError, match="blend is"):
            dataclasses.replace(config, **given)


def is_statistic(value):
    return isinstance(value, nnx.BatchStat)


def energy_of(weights):
    """Elastic energy of tight cloth on the walk, over that of lifting it by 1 cm."""
    (garment,) = TIGHT.garments().values()
    if weights is None:
        dresser = make_dresser([garment], method="lbs")
    else:
        inference = Inference(weights=weights, strain_iterations=0, collisions=False)
        dresser = make_dresser([garment], inference=inference)
    motion = load_motion("walk", fps=30.0)
    cloth = clothe(dresser, motion.rotations[4:8], motion.root[4:8], 30.0)[garment.name]
    table = jax.tree.map(lambda x: x[0], elastic_tables([garment], [None]))
    return float(jnp.mean(jax.vmap(table.energy)(cloth)) / table.lift(0.01))


def test_what_needs_one_garment_is_refused():
    with pytest.raises(ValueError, match="a garment of its own"):
        dataclasses.replace(CONFIG, adversarial=True)


@pytest.mark.release
def test_differences_are_those_along_edges():
    wardrobe = make_wardrobe([TIGHT, LOOSE], ("top",))
    *_, tables = prepare_garments(MODEL, wardrobe)
    x = jax.random.normal(jax.random.key(2), (2, wardrobe.num_vertices("top"), 3))
    along, weight = tables["top"].differences(x, jnp.asarray([0, 1]))
    for k, garment in enumerate(wardrobe.garments["top"]):
        a, b = mesh_edges(np.asarray(garment.mesh.faces)).vertices.T
        np.testing.assert_allclose(along[k, : len(a)], x[k, b] - x[k, a], atol=1e-6)
        assert float(weight[k].sum()) == len(a)


def test_a_network_that_cannot_see_garments_refuses_outfits(tmp_path):
    blind = dataclasses.replace(
        CONFIG, model=ModelConfig(resolution=32, width=4, templates=("top",))
    )
    with pytest.raises(FormatError, match="conditions = true"):
        train(blind, [sequence(TIGHT, 0.0)], tmp_path)


@pytest.mark.release
def test_what_depends_on_the_garment_is_learned(learned, body):
    """Whoever sees the motion alone is half of the difference wrong on both."""
    fallen = {}
    for outfit in (TIGHT, LOOSE):
        (garment,) = outfit.garments().values()
        inference = Inference(weights=learned, strain_iterations=0, collisions=False)
        dresser = make_dresser([garment], shape=outfit.params(), inference=inference)
        motion = load_motion("walk", fps=30.0)
        cloth = clothe(dresser, motion.rotations[4:12], motion.root[4:12], 30.0)[garment.name]
        bare = make_dresser([garment], method="lbs", shape=outfit.params())
        skinned = clothe(bare, motion.rotations[4:12], motion.root[4:12], 30.0)[garment.name]
        fallen[outfit] = float(jnp.mean(cloth[..., 1] - skinned[..., 1]))
    assert abs(fallen[TIGHT]) < 0.3 * OFF
    assert fallen[LOOSE] == pytest.approx(-OFF, abs=0.3 * OFF)


@pytest.mark.nightly
def test_garments_of_one_template_have_maps_of_their_own(learned, body, tmp_path):
    save_predictor(tmp_path / "w", learned, name="w")
    weights = load_predictor(tmp_path / "w")
    inference = Inference(weights=weights, strain_iterations=0, collisions=False)
    garments = [tailor("tee"), tailor("loose")]
    motion = load_motion("walk", fps=30.0)
    q, p = motion.rotations[:6], motion.root[:6]
    both = clothe(make_dresser(garments, inference=inference), q, p, 30.0)
    for g in garments:
        alone = clothe(make_dresser([g], inference=inference), q, p, 30.0)
        np.testing.assert_allclose(both[g.name], alone[g.name], atol=1e-5)
    dresser = make_dresser(garments, inference=inference)
    stream = init_stream(dresser, q[:2], p[:2])
    for k in range(6):
        stream, now = clothe_step(dresser, stream, q[k], p[k], 30.0)
        for g in garments:
            np.testing.assert_allclose(now[g.name], both[g.name][k], atol=1e-4)


def test_rows_have_a_sample_of_each_template():
    """Whichever part of the rows is loaded, it is that part of the whole batch."""
    tops = [sequence(TIGHT, 0.0), sequence(Outfit(wear=("loose",)), -OFF)]
    entries = [read_entry(s) for s in tops]
    w = make_wardrobe([e.outfit for e in entries], ("top",))
    load = functools.partial(
        load_frames, wardrobe=w, body=load_body(), window=MODEL.inputs.window, local=True
    )
    each = {
        name: FrameStream(chosen, load, lambda s: s, batch=4, seed=seed, capacity=1000)
        for seed, (name, chosen) in enumerate({"top": entries, "other": entries[:1]}.items())
    }
    streams = TemplateStreams({"top": each["top"]})
    assert streams.fps == 30.0 and streams.steps_per_epoch == 12
    both = TemplateStreams(each)
    assert both.steps_per_epoch == 12 and "other: walk" in both.identity
    whole, part = both.batches(3, slice(0, 4)), both.batches(3, slice(1, 3))
    try:
        for _ in range(10):
            a, b = next(whole), next(part)
            assert a["rotations"].shape[:2] == (4, 2) and a["garment_top"].shape == (4,)
            for k in a:
                np.testing.assert_array_equal(b[k], a[k][1:3])
    finally:
        whole.close()
        part.close()
