"""Losses in closed form; a run that is stopped and resumed is the same run."""

import dataclasses
import inspect
import json
import math
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.data import Sequence, is_trainable, make_wardrobe
from physxnet_jax.data._frames import MAX_OFFSET, load_frames
from physxnet_jax.devices import make_mesh
from physxnet_jax.dressing import Inference
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.evaluation import network, skinning
from physxnet_jax.garment import template
from physxnet_jax.models import PAPER, ModelConfig
from physxnet_jax.motion import load_motion
from physxnet_jax.training import (
    TrainConfig,
    adversarial_loss,
    discriminator_loss,
    load_data,
    map_picture,
    masked_l1,
    masked_l2,
    pooled_l1,
    read_metrics,
    soft_labels,
    train,
    vertex_loss,
)
from physxnet_jax.training._checkpoint import Checkpoints
from physxnet_jax.training._monitor import EarlyStopping, GanMonitor
from physxnet_jax.training._problem import TrainState
from physxnet_jax.training._targets import prepare_targets, target_offsets

CONFIG = TrainConfig(
    model=ModelConfig(resolution=32, width=4, templates=("bottom", "top")),
    epochs=8,
    batch=4,
    learning_rate=2e-3,
    discriminator_width=4,
    checkpoint_every=1000,
)
META = {"finite": True, "worst": {"penetration_max": 0.0}}


def raw(predictor):
    return Inference(weights=predictor, strain_iterations=0, collisions=False)


def sequence(name="walk", frames=20, seed=0, ok=True):
    motion = load_motion(name, fps=30.0)
    motion = dataclasses.replace(
        motion, rotations=motion.rotations[:frames], root=motion.root[:frames]
    )
    rng = np.random.default_rng(seed)
    offsets = {}
    for t in ("top", "bottom"):
        base = 0.02 * np.asarray(template(t).mesh.vertices)
        offsets[t] = (base[None] + rng.normal(0, 1e-3, (frames, 1, 3))).astype(np.float32)
    meta = {t: {**META, "finite": ok} for t in offsets}
    return Sequence(name, "train", motion, offsets, meta)


def test_soft_labels_follow_the_ranges_of_the_paper():
    for real, low, high in ((True, 0.7, 1.0), (False, 0.0, 0.3)):
        labels = np.asarray(soft_labels(jax.random.key(1), (20_000,), real=real))
        inside = (labels >= low) & (labels <= high)
        assert inside.mean() == pytest.approx(0.95, abs=0.01)
        flipped = labels[~inside]
        assert ((flipped >= 0.7) if not real else (flipped <= 0.3)).all()


def test_losses_match_closed_forms():
    zeros = jnp.zeros((3, 4))
    assert float(discriminator_loss(zeros, zeros, zeros + 1, zeros)) == pytest.approx(2 * np.log(2))
    assert float(adversarial_loss(zeros)) == pytest.approx(np.log(2))
    big = jnp.full((2,), 1e4)
    assert float(adversarial_loss(big)) == 0.0
    assert np.isfinite(float(discriminator_loss(-big, big, big * 0 + 1, big * 0)))
    predicted = jnp.ones((2, 3, 3))
    target = jnp.zeros((2, 3, 3)).at[1].set(5.0)
    valid = jnp.array([True, True, False])
    for distance, mean in ((masked_l1, 2.5), (masked_l2, 8.5)):
        one = distance(predicted, target, valid, jnp.array([1.0, 0.0]))
        both = distance(predicted, target, valid, jnp.array([1.0, 1.0]))
        none = distance(predicted, target, valid, jnp.zeros((2,)))
        assert (float(one), float(both), float(none)) == (1.0, mean, 0.0)
        # What the mask hides has no influence.
        hidden = distance(predicted.at[:, 2].set(99.0), target, valid, jnp.array([1.0, 0.0]))
        assert float(hidden) == 1.0

        def of(x, distance=distance):
            return distance(x, target, valid, jnp.array([1.0, 0.0]))

        broken = predicted.at[:, 2].set(jnp.nan).at[1].set(jnp.inf)
        assert float(of(broken)) == 1.0
        assert np.isfinite(jax.grad(of)(broken)).all()


@pytest.mark.nightly
def test_resumed_training_is_bitwise_equal_to_uninterrupted_training(tmp_path):
    data = [sequence()]
    config = dataclasses.replace(CONFIG, optimizer="muon")
    whole = train(config, data, tmp_path / "whole", steps=20)
    train(config, data, tmp_path / "parts", steps=10)
    # Data that were loaded before are the same data.
    parts = train(config, load_data(config, data), tmp_path / "parts", steps=20)
    for a, b in zip(jax.tree.leaves(whole.state), jax.tree.leaves(parts.state)):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    log = [json.loads(x) for x in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    assert log[-1]["step"] == 20 and log[-1]["skipped"] == 0
    with pytest.raises(PhysXNetError, match="learning_rate"):
        train(dataclasses.replace(config, learning_rate=1.0), data, tmp_path / "whole", steps=30)
    # A run that an earlier version began goes on: what it doesn't say is as by default.
    path = tmp_path / "whole" / "config.json"
    text = path.read_text()
    told = json.loads(text)
    assert told.pop("edge_share") == 0.0 and told["model"]["inputs"].pop("stride") == 1
    path.write_text(json.dumps(told))
    train(config, data, tmp_path / "whole", steps=20)
    path.write_text(json.dumps(told | {"seed": 5}))
    with pytest.raises(PhysXNetError, match="another seed"):
        train(config, data, tmp_path / "whole", steps=20)


@pytest.mark.release
def test_short_run_reduces_l1_with_bounded_gan_losses(tmp_path):
    config = dataclasses.replace(CONFIG, epochs=30)
    values = []
    train(config, [sequence()], tmp_path, steps=120, report=lambda a, b, m: values.append(m))
    assert values[-1]["l1"] < 0.5 * values[0]["l1"]
    assert 0.2 < values[-1]["discriminator"] < 2.5 and values[-1]["adversarial"] < 4.0


@pytest.mark.release
def test_nan_data_stops_training_after_too_many_skipped_steps(tmp_path):
    bad = sequence()
    spoiled = dataclasses.replace(bad.motion, root=bad.motion.root.at[:].set(jnp.nan))
    config = dataclasses.replace(CONFIG, max_skipped=3)
    with pytest.raises(PhysXNetError, match="not finite"):
        train(config, [dataclasses.replace(bad, motion=spoiled)], tmp_path, steps=40)


@pytest.mark.release
def test_detached_cloth_is_excluded_from_training(tmp_path):
    with pytest.raises(FormatError, match="no usable sequence"):
        train(CONFIG, [sequence(ok=False)], tmp_path, steps=2)
    with pytest.raises(FormatError, match="build a dataset"):
        train(CONFIG, [], tmp_path, steps=2)


def test_trainable_offsets_are_bounded_tightly_except_for_dresses():
    data = sequence()
    far = {t: x + np.float32([0.0, MAX_OFFSET + 0.1, 0.0]) for t, x in data.offsets.items()}
    skirt = {"dress": np.full((20, 9, 3), MAX_OFFSET, np.float32)}
    flown = dataclasses.replace(data, offsets=far | skirt, meta=data.meta | {"dress": META})
    told = {t: is_trainable(flown, t) for t in flown.offsets}
    assert told == {"top": False, "bottom": False, "dress": True}
    gone = dataclasses.replace(flown, offsets={"dress": 6 * skirt["dress"]})
    assert not is_trainable(gone, "dress")
    assert all(is_trainable(data, t) for t in data.offsets), "near ones do"


def test_empty_datasets_and_mixed_frame_rates_are_refused(body):
    usual = sequence()
    slow = dataclasses.replace(usual, motion=dataclasses.replace(usual.motion, fps=15.0))
    wardrobe = make_wardrobe([None], ("bottom",))
    for wrong, says in (((), "no sequence"), ((usual, slow), "different frame rates")):
        with pytest.raises(FormatError, match=says):
            load_frames(iter(wrong), wardrobe, body, window=5, local=True)
    assert len(load_frames(iter([usual]), wardrobe, body, window=5, local=True)) == 20


@pytest.mark.release
def test_paper_family_trains(tmp_path):
    config = dataclasses.replace(
        CONFIG, model=dataclasses.replace(CONFIG.model, inputs=PAPER), adversarial=False
    )
    values = []
    train(config, [sequence()], tmp_path, steps=40, report=lambda a, b, m: values.append(m))
    assert values[-1]["l1"] < values[0]["l1"]


@pytest.mark.release
def test_vertex_loss_reduces_the_vertex_error(tmp_path):
    model = dataclasses.replace(CONFIG.model, templates=("bottom",))
    config = dataclasses.replace(CONFIG, model=model, adversarial=False, vertex_share=1.0)
    data = sequence()
    predictor = train(dataclasses.replace(config, epochs=20), [data], tmp_path, steps=80)
    skinned = skinning()(data.motion, "bottom").positions
    moved = network(raw(predictor))(data.motion, "bottom").positions - skinned
    wanted = data.offsets["bottom"]
    left = np.linalg.norm(moved - wanted, axis=2).mean()
    assert left < 0.6 * np.linalg.norm(wanted, axis=2).mean()
    with pytest.raises(ValueError, match="0 to 1"):
        dataclasses.replace(config, vertex_share=2.0)
    with pytest.raises(ValueError, match="local family"):
        dataclasses.replace(config, model=dataclasses.replace(model, inputs=PAPER))


def test_pyramid_loss_matches_closed_forms():
    rows, columns = np.indices((8, 8))
    checks = jnp.asarray(np.where((rows + columns) % 2, 1.0, -1.0), jnp.float32)
    checks = jnp.broadcast_to(checks[None, :, :, None], (2, 8, 8, 3))
    zeros, everywhere = jnp.zeros_like(checks), jnp.ones((2, 8, 8, 1))
    for scales in (1, 2, 4):
        assert float(pooled_l1(zeros + 0.5, zeros, everywhere, scales)) == 0.5
        assert float(pooled_l1(checks, zeros, everywhere, scales)) == 1.0 / scales
        assert float(pooled_l1(checks, zeros, 0.0 * everywhere, scales)) == 0.0
    # One size is the loss at texels, whatever counts; what doesn't has no gradient.
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.normal(size=(2, 8, 8, 3)), jnp.float32) for _ in range(2))
    valid, weight = jnp.asarray(rng.random(64) < 0.6), jnp.asarray([1.0, 0.0])
    mask = (weight[:, None] * valid.astype(jnp.float32)[None]).reshape(2, 8, 8, 1)
    flat = masked_l1(a.reshape(2, 64, 3), b.reshape(2, 64, 3), valid, weight)
    np.testing.assert_allclose(float(pooled_l1(a, b, mask, 1)), float(flat), rtol=1e-6)
    slope = jax.grad(pooled_l1)(a, b, mask, 4)
    assert np.isfinite(slope).all() and not np.asarray(slope)[np.asarray(mask[..., 0]) == 0].any()


def test_edge_loss_is_invariant_to_a_common_shift():
    edges = jnp.asarray([[0, 1], [1, 2]])
    target, weight = jnp.zeros((2, 3, 3)), jnp.asarray([1.0, 0.0])
    shifted = target + 2.0
    bent = target.at[0, 1].set(3.0)
    for distance, moved, folded, differences in (
        (masked_l1, 2.0, 1.0, 3.0),
        (masked_l2, 4.0, 3.0, 9.0),
    ):
        for share in (0.0, 0.25, 1.0):
            value = vertex_loss(shifted, target, edges, weight, distance, share)
            assert float(value) == pytest.approx((1.0 - share) * moved)
            value = vertex_loss(bent, target, edges, weight, distance, share)
            assert float(value) == pytest.approx((1.0 - share) * folded + share * differences)


@pytest.mark.release
def test_edge_and_pyramid_losses_reduce_the_error(tmp_path):
    model = dataclasses.replace(CONFIG.model, templates=("bottom",))
    config = dataclasses.replace(CONFIG, model=model, adversarial=False, epochs=20)
    config = dataclasses.replace(config, vertex_share=0.7, edge_share=0.5, pyramid_levels=3)
    data = sequence()
    predictor = train(config, [data], tmp_path, steps=80)
    skinned = skinning()(data.motion, "bottom").positions
    left = (
        network(raw(predictor))(data.motion, "bottom").positions - skinned - data.offsets["bottom"]
    )
    there = np.linalg.norm(data.offsets["bottom"], axis=2).mean()
    assert np.linalg.norm(left, axis=2).mean() < 0.8 * there


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"vertex_share": 0.5, "edge_share": 1.5}, "0 to 1"),
        ({"edge_share": 0.5}, "share of vertex_share"),
        ({"pyramid_levels": 0}, "at least 1"),
        ({"pyramid_levels": 7}, "halve that often"),
        ({"pyramid_levels": 2, "loss": "l2"}, "choose one"),
        ({"epochs": 0}, "epochs is 0"),
        ({"patience": 0}, "patience is 0"),
        ({"batch": 0}, "batch is 0"),
        ({"checkpoint_every": -1}, "checkpoint_every is -1"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"b1": 1.0}, "b1 is 1.0"),
    ],
)
def test_invalid_training_settings_are_refused(changes, says):
    with pytest.raises(ValueError, match=says):
        dataclasses.replace(CONFIG, **changes)


@pytest.mark.nightly
def test_best_validation_checkpoint_is_kept_and_training_stops_early(tmp_path):
    config = dataclasses.replace(CONFIG, validation=("b",), validate_every=4, epochs=40, patience=2)
    data = [dataclasses.replace(sequence(seed=k), name=n) for k, n in enumerate("ab")]
    # A far too high rate makes it worse sooner or later.
    config = dataclasses.replace(config, learning_rate=0.3, adversarial=False, max_skipped=10**6)
    train(config, data, tmp_path)
    log = read_metrics(tmp_path)
    assert json.loads((tmp_path / "config.json").read_text())["data"].startswith("a 20 ")
    measured = [x["validation_mm"] for x in log if "validation_mm" in x]
    best = int(np.argmin(measured))
    assert len(measured) - 1 - best == 2, "two without a better one, then it stopped"
    steps = [x["step"] for x in log if "validation_mm" in x]
    assert [p.name for p in (tmp_path / "best").iterdir() if p.name.isdigit()] == [str(steps[best])]
    assert max(x["step"] for x in log) < 40 * 5
    # Asked again, it does no step more.
    train(config, data, tmp_path)
    assert len(read_metrics(tmp_path)) == len(log)
    with pytest.raises(FormatError, match="aren't among"):
        train(dataclasses.replace(config, validation=("c",)), data, tmp_path / "c", steps=1)
    assert list((tmp_path / "events").iterdir()), "TensorBoard can show it"


@pytest.mark.nightly
def test_mirror_augmentation_doubles_the_training_data(tmp_path):
    config = dataclasses.replace(
        CONFIG,
        mirror_augmentation=True,
        validation=("b",),
        adversarial=False,
        validate_every=100,
        epochs=1,
    )
    config = dataclasses.replace(config, loss="l2")
    data = [dataclasses.replace(sequence(seed=k), name=n) for k, n in enumerate("ab")]
    seen = []
    train(config, data, tmp_path, report=lambda done, total, _: seen.append((done, total)))
    # Twice twenty frames, and nothing of what is kept for measuring.
    told = json.loads((tmp_path / "config.json").read_text())["data"].split(", ")
    assert [t.rsplit(" ", 1)[0] for t in told] == ["a 20", "a 20"]
    assert seen[-1] == (10, 10)
    losses = [x["l2"] for x in read_metrics(tmp_path) if "loss" in x]
    assert losses and all(0.0 < x < 1.0 for x in losses)


def test_early_stopping_ignores_metrics_after_the_checkpoint(tmp_path):
    lines = [{"step": s, "validation_mm": v} for s, v in ((4, 3.0), (8, 2.0), (12, 1.0))]
    (tmp_path / "metrics.jsonl").write_text(
        "\n".join(json.dumps(x) for x in lines) + '\n{"step": 16, "vali'
    )
    assert read_metrics(tmp_path) == lines
    watch = EarlyStopping(lines, 8, 2)
    assert watch.best == 2.0 and not watch.exhausted
    assert [watch.update(2.5), watch.update(2.1)] == [False, False] and watch.exhausted
    assert watch.update(1.9) and not watch.exhausted


def test_early_stopping_counts_repeated_steps_once_and_ignores_nan():
    told = ((4, 3.0), (8, 2.0), (12, 2.5), (8, 2.0), (12, 2.5))
    lines = [{"step": s, "validation_mm": v} for s, v in told]
    assert not EarlyStopping(lines, 12, 2).exhausted, "one without a better one, told twice"
    watch = EarlyStopping([], 0, 3)
    assert watch.update(5.0) and not watch.update(float("nan"))
    assert watch.best == 5.0 and watch.update(4.0)


@pytest.mark.nightly
def test_interrupted_run_has_the_validation_of_an_uninterrupted_one(tmp_path):
    model = dataclasses.replace(CONFIG.model, templates=("bottom",))
    config = dataclasses.replace(
        CONFIG, model=model, validation=("b",), validate_every=4, epochs=2, adversarial=False
    )
    data = [dataclasses.replace(sequence(seed=k), name=n) for k, n in enumerate("ab")]
    train(config, data, tmp_path / "whole")
    train(config, data, tmp_path / "parts", steps=3)
    with (tmp_path / "parts/metrics.jsonl").open("a") as log:
        log.write('{"step": 4, "lo')
    train(config, data, tmp_path / "parts")
    logs = [read_metrics(tmp_path / n) for n in ("whole", "parts")]
    validated = [
        [(x["step"], x["validation_mm"]) for x in log if "validation_mm" in x] for log in logs
    ]
    assert [s for s, _ in validated[0]] == [4, 8, 10]
    assert validated[1] == validated[0], "no more often, and the line after the cut one is there"
    # Other cloth of the same names is another run.
    other = [data[1], dataclasses.replace(sequence(seed=2), name="a")]
    with pytest.raises(PhysXNetError, match="another data"):
        train(config, other, tmp_path / "parts")


def test_an_interrupt_waits_for_the_checkpoint(tmp_path, monkeypatch):
    state = TrainState(**{f.name: jnp.zeros(()) for f in dataclasses.fields(TrainState)})
    kept = Checkpoints(tmp_path / "kept")
    save = kept._manager.save

    def interrupted(*args, **options):
        signal.raise_signal(signal.SIGINT)
        return save(*args, **options)

    monkeypatch.setattr(kept._manager, "save", interrupted)
    # Started in the background, a process ignores it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            kept.save(dataclasses.replace(state, step=jnp.int32(3)))
    finally:
        signal.signal(signal.SIGINT, before)
    kept.close()
    again = Checkpoints(tmp_path / "kept")
    assert int(again.latest(state).step) == 3
    again.close()


def test_checkpoints_after_the_resumed_step_are_deleted(tmp_path):
    state = TrainState(**{f.name: jnp.zeros(()) for f in dataclasses.fields(TrainState)})
    at = lambda n: dataclasses.replace(state, step=jnp.int32(n))  # noqa: E731
    kept = Checkpoints(tmp_path / "best", keep=1)
    kept.save(at(8))
    with pytest.raises(PhysXNetError, match="step 4 wasn't saved"):
        kept.save(at(4))
    kept.forget_after(4)
    kept.save(at(4))
    assert int(kept.latest(at(0)).step) == 4
    for file in (tmp_path / "best/4").rglob("*"):
        if file.is_file() and "state" in str(file.relative_to(tmp_path)):
            file.write_bytes(b"never")
    with pytest.raises(PhysXNetError, match="is damaged"):
        kept.latest(at(0))
    kept.close()


def test_gan_alarm_is_raised_by_extreme_discriminator_accuracy():
    for accuracy, alarm in ((1.0, 1.0), (0.75, 0.0), (0.5, 1.0)):
        players = GanMonitor()
        for _ in range(100):
            seen = players.update({"discriminator_accuracy": accuracy})
        assert seen["gan_alarm"] == alarm
        assert seen["discriminator_accuracy_mean"] == pytest.approx(accuracy)
    assert GanMonitor().update({"l1": 1.0}) == {}


@pytest.mark.parametrize(
    ("loss", "value", "alarm"),
    [
        ("discriminator", 2 * math.log(2), 0.0),  # it says that it doesn't know
        ("discriminator", 2.0, 1.0),
        ("adversarial", -math.log(0.185), 0.0),  # it knows, and is as unsure as its labels
        ("adversarial", -math.log(0.04), 1.0),
        ("adversarial", math.nan, 1.0),
    ],
)
def test_gan_alarm_is_raised_by_either_loss_at_any_accuracy(loss, value, alarm):
    players = GanMonitor()
    for _ in range(100):
        usual = {"discriminator_accuracy": 0.75, "discriminator": 1.2, "adversarial": 1.0}
        seen = players.update({**usual, loss: value})
    assert seen["gan_alarm"] == alarm


@pytest.mark.nightly
def test_bfloat16_training_matches_float32_closely(tmp_path):
    last = {}
    for precision in ("float32", "bfloat16"):
        config = dataclasses.replace(CONFIG, precision=precision, adversarial=True)
        values = []
        train(
            config,
            [sequence()],
            tmp_path / precision,
            steps=40,
            report=lambda a, b, m, v=values: v.append(m["l1"]),
        )
        last[precision] = values[-1]
    assert last["bfloat16"] == pytest.approx(last["float32"], rel=0.25)
    assert last["bfloat16"] != last["float32"], "it isn't the same arithmetic"


def test_map_pictures_show_zero_as_grey():
    zero, one = np.zeros((4, 4, 3), np.float32), np.ones((4, 4, 3), np.float32)
    picture = map_picture(zero, one)
    assert picture.shape == (4, 12, 3)
    assert (picture[:, :4] == 127).all() and (picture[:, 4:8] == 255).all()
    assert (picture[:, 8:] == 0).all()


def test_padding_of_the_last_batch_does_not_affect_validation(monkeypatch):
    """Held-out frames of which the last is bad: the mean is that of the frames."""
    from types import SimpleNamespace

    from physxnet_jax.training import _loop

    config = dataclasses.replace(CONFIG, batch=8)
    templates = config.model.templates
    errors = np.ones(25)
    errors[-1] = 10.0

    def take(frames, index):
        return {"index": index} | {f"weight_{t}": np.ones((len(index), 5)) for t in templates}

    def look(state, batch):
        losses = {}
        for t in templates:
            share = batch[f"weight_{t}"].sum(axis=1)
            losses[t] = (share * errors[batch["index"]]).sum() / share.sum()
        return losses, {t: (np.zeros((8, 2, 2, 3)),) * 2 for t in templates}

    monkeypatch.setattr(_loop, "take", take)
    # What is handed over only looks like frames and steps.
    validate = inspect.unwrap(_loop._validate)
    monkeypatch.setattr(_loop, "_held_batches", inspect.unwrap(_loop._held_batches))
    monkeypatch.setattr(_loop, "eval_step", lambda problem, *rest: look(*rest))
    found, _ = validate(SimpleNamespace(config=config), None, range(25), make_mesh(8))
    assert found["validation_mm"] == pytest.approx(errors[::3].mean())


def test_gan_monitor_resumes_its_running_means():
    whole, first = GanMonitor(), GanMonitor()
    rng = np.random.default_rng(0)
    noted = []
    for step in range(60):
        seen = {"discriminator_accuracy": float(rng.uniform()), "adversarial": float(step)}
        want = whole.update(seen)
        if step < 40:
            noted.append({"step": float(step), **first.update(seen)})
            # What was written after the last checkpoint is done again.
            late = {"step": 99.0, "discriminator_accuracy_mean": 0.0, "adversarial_mean": 0.0}
            rest = GanMonitor([*noted, late], step)
        else:
            got = rest.update(seen)
    assert got == want


@pytest.mark.release
def test_paper_family_targets_start_at_the_skin(body, rest):
    """At rest, without an offset: from each texel to the cloth that its ray meets."""
    _, surface, tables = prepare_targets(ModelConfig(resolution=32, templates=("bottom",)))
    table, joints = tables["bottom"], len(body.parents)
    pose = jnp.tile(jnp.eye(3), (1, joints, 1, 1)), jnp.zeros((1, joints, 3))
    worn = template("bottom").rest_vertices(rest)
    valid = np.asarray(table.to_cloth.valid)
    for up in (0, 100):  # tenths of a millimetre
        stored = jnp.zeros((1, len(worn), 3), jnp.int16).at[..., 1].set(up)
        seen = np.asarray(target_offsets(stored, table, surface, *pose, "paper"))[0][valid]
        wanted = np.asarray(table.to_cloth @ worn - surface.rest)[valid] + [0.0, 1e-4 * up, 0.0]
        np.testing.assert_allclose(seen, wanted, atol=1e-5)
        local = np.asarray(target_offsets(stored, table, surface, *pose, "local"))[0][valid]
        np.testing.assert_allclose(local, np.tile([0.0, 1e-4 * up, 0.0], (len(seen), 1)), atol=1e-6)


@pytest.mark.release
def test_loss_is_the_weighted_sum_and_errors_are_in_millimetres(tmp_path):
    data = [dataclasses.replace(sequence(seed=k), name=n) for k, n in enumerate("ab")]
    config = dataclasses.replace(CONFIG, l1_weight=10.0, validation=("b",), validate_every=1)
    train(config, data, tmp_path, steps=1)
    log = read_metrics(tmp_path)
    (told,) = (x for x in log if "loss" in x)
    assert told["loss"] == pytest.approx(told["adversarial"] + 10.0 * told["l1"], rel=1e-4)
    # Offsets are up to two centimetres: so is the error of a network that knows nothing.
    wanted = 1e3 * np.abs(data[1].offsets["bottom"]).mean()
    (measured,) = (x["validation_mm"] for x in log if "validation_mm" in x)
    assert 0.3 * wanted < measured < 5.0 * wanted
    assert 0.3 * wanted < told["l1_mm_bottom"] < 5.0 * wanted


def test_validation_without_usable_cloth_is_refused(tmp_path):
    """On what is held out, as on what is learned from."""
    data = [sequence(seed=0), dataclasses.replace(sequence(seed=1, ok=False), name="b")]
    config = dataclasses.replace(CONFIG, validation=("b",))
    with pytest.raises(FormatError, match="no usable cloth in b"):
        train(config, data, tmp_path, steps=1)


@pytest.mark.nightly
def test_train_returns_the_weights_of_the_best_validation(tmp_path, monkeypatch):
    """Best after two of four steps: what comes back is the run of two."""
    data = [dataclasses.replace(sequence(seed=k), name=n) for k, n in enumerate("ab")]
    config = dataclasses.replace(CONFIG, adversarial=False, validation=("b",), validate_every=1)
    found = {}
    for steps in (2, 4):
        told = iter([3.0, 1.0, 2.0, 2.5])
        monkeypatch.setattr(
            "physxnet_jax.training._loop._validate",
            lambda *_, told=told: ({"validation_mm": next(told)}, {}),
        )
        found[steps] = jax.tree.leaves(
            train(config, data, tmp_path / str(steps), steps=steps).state
        )
    for a, b in zip(found[2], found[4], strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
