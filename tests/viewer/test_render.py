"""Pictures: not empty, and videos of the right length."""

import gc

import numpy as np
import pytest

from physxnet_jax.dressing import dress
from physxnet_jax.errors import FormatError
from physxnet_jax.viewer import render_frame, render_preview

pytest.importorskip("pyvista")


# imageio's own reader leaves ffmpeg's pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_dressed_person_is_in_the_picture(tmp_path):
    clip = dress("walk", ["bottom"], method="lbs", frames=4)
    image = render_frame(clip.meshes, 2, size=(160, 192))
    assert image.shape == (192, 160, 3)
    blue = (image[..., 2].astype(int) - image[..., 0]) > 30
    assert 0.005 < blue.mean() < 0.7, "no blue trousers in the picture"
    for name in ("a.png", "a.gif", "a.mp4"):
        path = render_preview(tmp_path / name, clip.meshes, clip.fps, size=(160, 192))
        assert path.stat().st_size > 1000
    import imageio.v3 as iio

    frames = iio.imread(tmp_path / "a.mp4").astype(int)
    gc.collect()
    assert frames.shape[0] == 4
    assert np.abs(frames[3] - frames[0]).mean() > 0.3, "nobody moves"
    assert np.asarray(iio.imread(tmp_path / "a.png")).std() > 5


def test_other_extensions_are_refused(tmp_path):
    with pytest.raises(FormatError, match=r"\.mp4"):
        render_preview(tmp_path / "a.avi", [], 30.0)
