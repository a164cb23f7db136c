"""Pictures: not empty, and videos of the right length."""

import dataclasses
import gc

import numpy as np
import pytest

from physxnet_jax.dressing import dress
from physxnet_jax.errors import FormatError
from physxnet_jax.viewer import render_columns, render_frame, render_preview

pytest.importorskip("pyvista")


@pytest.mark.release
# imageio's own reader leaves ffmpeg's pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_rendered_frames_show_a_dressed_body(tmp_path):
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


def test_jumping_body_stays_in_the_frame():
    person = dress("walk", ["bottom"], method="lbs", frames=2).meshes[0]
    high = person.positions + np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.9, 0.0]]], np.float32)
    jump = dataclasses.replace(person, positions=high)

    def seen(frame):
        image = render_frame([jump], frame, size=(160, 192)).astype(int)
        return image[..., 0] - image[..., 2] > 20

    for frame in (0, 1):
        skin = seen(frame)
        assert skin.any() and not skin[:3].any() and not skin[-3:].any()
    assert abs(seen(0).sum() - seen(1).sum()) < 0.25 * seen(0).sum()


def test_rendered_columns_share_moments_and_have_titles(tmp_path):
    import imageio.v3 as iio

    long = dress("walk", ["bottom"], method="lbs", frames=2)
    columns = {"one": long.meshes, "two": long.meshes[:1]}
    path = render_columns(tmp_path / "a.png", columns, 30.0, size=(160, 192))
    sheet = np.asarray(iio.imread(path)).astype(int)
    assert sheet.shape[:2] == (2 * 192, 2 * 160), "a row for each column, two moments"
    blue = (sheet[..., 2] - sheet[..., 0]) > 30
    assert blue[:192].mean() > 5 * blue[192:].mean(), "trousers in the first row alone"
    assert (sheet[:24, 40:120].sum(axis=2) < 300).any(), "no title"
    short = dress("walk", ["bottom"], method="lbs", frames=1)
    with pytest.raises(FormatError, match="numbers must be equal"):
        render_columns(tmp_path / "b.png", {"a": long.meshes, "b": short.meshes}, 30.0)
    assert not (tmp_path / "b.png").exists()


def test_unknown_extensions_and_empty_columns_are_refused(tmp_path):
    with pytest.raises(FormatError, match=r"\.mp4"):
        render_preview(tmp_path / "a.avi", [], 30.0)
    with pytest.raises(FormatError, match="frames"):
        render_columns(tmp_path / "a.png", {}, 30.0)
