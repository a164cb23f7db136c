"""The one inference path: steps that aren't requested are absent, every entry point agrees."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.dressing import (
    Inference,
    Stream,
    clothe,
    clothe_step,
    dress,
    infer_clip,
    init_stream,
    make_dresser,
    pose_clip,
)
from physxnet_jax.motion import load_motion

PLAIN = Inference(weights="nano", strain_iterations=0, collisions=False)


@pytest.fixture(scope="module")
def motion():
    walk = load_motion("walk", fps=30.0)
    return dataclasses.replace(walk, rotations=walk.rotations[:3], root=walk.root[:3])


def jaxpr(dresser, motion):
    text = str(
        jax.make_jaxpr(lambda q, p: clothe(dresser, q, p, 30.0).vertices)(
            motion.rotations, motion.root
        )
    )
    return re.sub(r"0x[0-9a-f]+", "", text)


@pytest.mark.nightly
def test_sixty_frames_a_second_are_every_other_of_thirty():
    """Features are of the same moments; before the clip motion is extrapolated either way."""
    slow, fast = (load_motion("punch", fps=fps) for fps in (30.0, 60.0))
    dresser = make_dresser(["bottom"], inference=PLAIN)
    assert dresser.history_length(60.0) == 2 * dresser.history_length(30.0)
    # From the first frame on whose window begins within the clip.
    first = dresser.history_length(30.0)
    count = first + 6
    a = clothe(dresser, slow.rotations[:count], slow.root[:count], 30.0)["bottom"]
    count = 2 * count - 1
    b = clothe(dresser, fast.rotations[:count], fast.root[:count], 60.0)["bottom"]
    np.testing.assert_allclose(b[::2][first:], a[first:], atol=2e-4)
    stream = init_stream(dresser, fast.rotations[0], fast.root[0])
    with pytest.raises(ValueError, match="pass fps to init_stream"):
        clothe_step(dresser, stream, fast.rotations[0], fast.root[0], 60.0)
    stream = init_stream(dresser, fast.rotations[0], fast.root[0], 60.0)
    assert clothe_step(dresser, stream, fast.rotations[0], fast.root[0], 60.0)[1].ok


@pytest.mark.release
def test_unrequested_steps_are_absent_from_the_program(motion):
    wear = ["top", "bottom"]
    plain = make_dresser(wear, inference=PLAIN)
    assert (plain.strain, plain.colliders, plain.layers) == (None, None, None)
    whole = make_dresser(wear, inference=Inference(weights="nano"))
    texts = {
        "plain": jaxpr(plain, motion),
        "strain": jaxpr(dataclasses.replace(plain, strain=whole.strain), motion),
        "collisions": jaxpr(dataclasses.replace(plain, colliders=whole.colliders), motion),
        "whole": jaxpr(whole, motion),
    }
    assert len(texts["plain"]) < len(texts["strain"]) < len(texts["whole"])
    assert len(texts["plain"]) < len(texts["collisions"]) < len(texts["whole"])
    # The strain limit is the only loop of eight; removing the step gives the program back.
    assert "length=8" in texts["strain"] and "length=8" not in texts["plain"]
    without = dataclasses.replace(whole, strain=None, colliders=None, layers=None)
    assert jaxpr(without, motion) == texts["plain"]


def test_skinning_needs_no_binding(motion):
    dresser = make_dresser(["bottom"], method="lbs", inference=Inference(collisions=False))
    assert dresser.predictor is None and dresser.strain is None and dresser.history_length() == 0
    assert not hasattr(dresser.worn[0], "binding")
    whole = clothe(dresser, motion.rotations, motion.root, 30.0)["bottom"]
    stream = init_stream(dresser, motion.rotations[0], motion.root[0])
    assert stream.points is None
    for k in range(3):
        stream, cloth = clothe_step(dresser, stream, motion.rotations[k], motion.root[k], 30.0)
        np.testing.assert_allclose(cloth["bottom"], whole[k], atol=1e-6)


def test_blocks_are_delivered_as_they_are_finished(motion):
    seen = []
    clip = dress(
        "walk",
        ["bottom"],
        method="lbs",
        frames=20,
        include_body=False,
        on_block=lambda b: seen.append((b.start, b.positions["bottom"].copy())),
    )
    assert [start for start, _ in seen] == [0, 16]
    whole = np.concatenate([x for _, x in seen])
    np.testing.assert_array_equal(whole, clip.garments[0].positions)


@pytest.mark.release
def test_clip_matches_clothe(motion):
    dresser = make_dresser(["bottom"], inference=PLAIN)
    posed = pose_clip(dresser.body, dresser.rest, motion)
    (block,) = infer_clip(dresser, posed)
    layer = clothe(dresser, motion.rotations, motion.root, 30.0)["bottom"]
    np.testing.assert_allclose(block.positions["bottom"], layer, atol=1e-6)


@pytest.mark.release
def test_test_time_augmentation_is_an_option(motion):
    plain = make_dresser(["bottom"], inference=PLAIN)
    both = make_dresser(["bottom"], inference=dataclasses.replace(PLAIN, tta=True))
    assert both.predictor.mirror_tta and not plain.predictor.mirror_tta
    a, b = (clothe(d, motion.rotations, motion.root, 30.0)["bottom"] for d in (plain, both))
    assert 1e-4 < float(jnp.abs(a - b).max()) < 0.1


@pytest.mark.release
def test_results_are_mappings_with_short_text(motion):
    dresser = make_dresser(["bottom"], inference=PLAIN)
    cloth = clothe(dresser, motion.rotations, motion.root, 30.0)
    assert dict(cloth).keys() == {"bottom"} and len(cloth) == 1 and "bottom" in cloth
    assert cloth == cloth and cloth != dataclasses.replace(cloth)
    assert "f32[3,2726,3]" in repr(cloth) and len(repr(dresser)) < 1000
    with pytest.raises(TypeError):
        Stream(None)
