"""Fine-tuning to one garment: what changes, what stays, and that it resumes to the same."""

import dataclasses

import jax
import numpy as np
import pytest
from flax import nnx

from physxnet_jax.dressing import AdaptConfig, Inference, adapt, make_dresser
from physxnet_jax.errors import MotionError, PhysXNetError, WeightsError
from physxnet_jax.models import fold_batch_norm, load_predictor
from physxnet_jax.motion import load_motion

CONFIG = AdaptConfig(steps=4, windows=1, frames=3, learning_rate=3e-4, validate_every=2)
SHORT = {"weights": "nano", "frames": 6, "config": CONFIG}


def parameters(predictor):
    """All parameters and statistics by name."""
    leaves = jax.tree_util.tree_leaves_with_path(predictor.state)
    return {jax.tree_util.keystr(p, simple=True, separator="."): np.asarray(x) for p, x in leaves}


@pytest.fixture(scope="module")
def taught():
    return adapt("bottom:fabric=wool", **SHORT)


@pytest.mark.nightly
def test_potential_falls_and_only_the_decoder_of_the_garment_changes(taught):
    assert taught.loss[1] < taught.loss[0] and taught.potential[1] < taught.potential[0]
    assert taught.steps in (2, 4) and taught.rmse_mm is None
    before, after = parameters(load_predictor("nano")), parameters(taught.predictor)
    assert before.keys() == after.keys()
    changed = {k for k in before if not np.array_equal(before[k], after[k])}
    assert changed and all("decoders.bottom" in k for k in changed)
    assert not any("mean" in k or "var" in k for k in changed)


@pytest.mark.nightly
def test_an_interrupted_run_resumes_to_the_same_network(taught, tmp_path):
    class Killed(Exception):
        pass

    def killer(stage, done, total):
        if stage == "steps" and done == 3:
            raise Killed

    folder = tmp_path / "unfinished"
    with pytest.raises(Killed):
        adapt("bottom:fabric=wool", **SHORT, progress=killer, resume=folder)
    assert folder.is_dir()
    with pytest.raises(PhysXNetError, match="another garment or with other settings"):
        adapt("bottom:fabric=silk", **SHORT, resume=folder)
    seen = []
    again = adapt(
        "bottom:fabric=wool", **SHORT, resume=folder, progress=lambda s, k, n: seen.append(k)
    )
    # From the step of the last checkpoint.
    assert seen == [3, 4] and not folder.exists()
    one, other = parameters(taught.predictor), parameters(again.predictor)
    assert all(np.array_equal(one[k], other[k]) for k in one)
    other_files = tmp_path / "mine"
    other_files.mkdir()
    (other_files / "notes.txt").write_text("mine")
    with pytest.raises(PhysXNetError, match="other files"):
        adapt("bottom:fabric=wool", **SHORT, resume=other_files)


@pytest.mark.nightly
def test_a_run_that_does_worse_returns_the_network_as_it_was():
    wild = dataclasses.replace(CONFIG, learning_rate=30.0, steps=2)
    done = adapt("bottom", weights="nano", frames=6, config=wild)
    assert done.steps == 0 and done.loss[0] == done.loss[1]
    before, after = parameters(load_predictor("nano")), parameters(done.predictor)
    assert all(np.array_equal(before[k], after[k]) for k in before)


@pytest.mark.nightly
def test_simulations_lower_the_distance_from_the_simulation():
    more = dataclasses.replace(CONFIG, steps=60, windows=2, learning_rate=1e-3, validate_every=20)
    done = adapt("bottom", weights="nano", frames=12, config=more, simulate=True)
    assert done.rmse_mm is not None and done.rmse_mm[1] < 0.95 * done.rmse_mm[0]
    # What was learned is worn.
    worn = make_dresser(["bottom"], inference=Inference(weights=done.predictor))
    assert worn.predictor is not None


@pytest.mark.release
def test_motions_that_are_too_short_are_refused():
    with pytest.raises(MotionError, match="walk is shorter than a window"):
        adapt("bottom", weights="nano", motions=[load_motion("walk", fps=30.0)[:5]])


def test_what_cannot_be_adapted_is_refused():
    with pytest.raises(ValueError, match="frames is 2"):
        AdaptConfig(frames=2)
    with pytest.raises(ValueError, match="steps"):
        AdaptConfig(steps=0)
    with pytest.raises(ValueError, match="potential"):
        AdaptConfig(potential=-1.0)
    with pytest.raises(MotionError, match="shorter than a window"):
        adapt("bottom", weights="nano", frames=5)
    nano = load_predictor("nano")
    with pytest.raises(WeightsError, match="as it was loaded"):
        adapt("bottom", weights=dataclasses.replace(nano, mirror_tta=True))
    with pytest.raises(WeightsError, match="as it was loaded"):
        adapt("bottom", weights=fold_batch_norm(nano))
    custom = nnx.Linear(2, 2, rngs=nnx.Rngs(0))
    graph, state = nnx.split(custom)
    with pytest.raises(WeightsError, match="as it was loaded"):
        adapt("bottom", weights=dataclasses.replace(nano, graph=graph, state=state))
