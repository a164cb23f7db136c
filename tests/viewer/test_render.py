"""Pictures: not empty, and videos of the right length."""

import dataclasses
import gc
import threading

import numpy as np
import pytest

from physxnet_jax.dressing import dress
from physxnet_jax.errors import FormatError
from physxnet_jax.viewer import load_renderer, render_columns, render_frame, render_preview

pytest.importorskip("pyvista")


def cloth(image):
    """Pixels of dark trousers; titles are darker still."""
    image = np.asarray(image).astype(int)
    dark = (image.max(axis=2) < 110) & (image.min(axis=2) > 12)
    return dark & (image[..., 2] > image[..., 0])


def skin(image):
    image = np.asarray(image).astype(int)
    return image[..., 0] - image[..., 2] > 20


@pytest.fixture(scope="module")
def person():
    return dress("walk", ["bottom"], method="lbs", frames=24).meshes


def turned(meshes, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)
    return [dataclasses.replace(m, positions=m.positions @ turn.T) for m in meshes]


@pytest.mark.release
@pytest.mark.parametrize("camera", ["three-quarter", "front", "back", "follow", "turntable"])
@pytest.mark.parametrize("size", [(160, 192), (256, 144)])
def test_the_person_fills_the_picture(person, camera, size):
    for frame in (0, 13, 23):
        image = render_frame(person, frame, size=size, camera=camera)
        rows, columns = np.nonzero(skin(image) | cloth(image))
        width, height = size
        assert rows.min() > 0 and rows.max() < height - 1
        assert columns.min() > 0 and columns.max() < width - 1
        assert np.ptp(rows) > 0.72 * height
        assert abs(columns.mean() - width / 2) < 0.12 * width


@pytest.mark.release
def test_pictures_do_not_depend_on_where_the_person_goes(person):
    """Fixed cameras stand before the person whatever the direction of the walk."""
    there = turned(person, 2.0)
    for camera in ("front", "three-quarter", "follow"):
        a, b = (skin(render_frame(m, 5, size=(160, 192), camera=camera)) for m in (person, there))
        assert (a != b).mean() < 0.01
    # The control: seen from the side, the person looks another way.
    side = skin(render_frame(person, 5, size=(160, 192), camera="front"))
    other = skin(render_frame(person, 5, size=(160, 192), camera="three-quarter"))
    assert (side != other).mean() > 0.01


def test_a_turntable_goes_around_once(person):
    from physxnet_jax.viewer._studio import Studio

    studio = Studio(person, (64, 64), camera="turntable")
    studio.close()
    way = (studio._eyes - studio._targets)[:, [0, 2]]
    angle = np.unwrap(np.arctan2(way[:, 0], way[:, 1]))
    np.testing.assert_allclose(np.diff(angle), 2 * np.pi / 24, atol=1e-6)


def test_the_back_is_seen_from_opposite_the_front(person):
    from physxnet_jax.viewer._studio import Studio

    ways = []
    for camera in ("front", "back"):
        studio = Studio(person, (64, 64), camera=camera)
        studio.close()
        ways.append((studio._eyes - studio._targets)[:, [0, 2]])
    front, back = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in ways)
    np.testing.assert_allclose(back, -front, atol=1e-6)


def test_headings_follow_a_turning_person(person):
    from physxnet_jax.viewer._studio import headings

    np.testing.assert_allclose(headings(turned(person, 1.3)), headings(person) + 1.3, atol=1e-4)
    assert np.abs(headings(person)).max() < 0.3, "the built-in walk goes along Z"


def test_feet_have_a_shadow_and_backgrounds_their_colour(person):
    plain = render_frame(person, 5, size=(160, 192), background="#20a040").astype(int)
    assert np.abs(plain[2, 2] - [32, 160, 64]).max() <= 2
    ground = plain[160:, :, 1][~(skin(plain) | cloth(plain))[160:]]
    assert ground.min() < 120 and ground.max() > 155
    dark = render_frame(person, 5, size=(160, 192), background="dark").astype(int)
    assert dark[2, 2].max() < 60
    with pytest.raises(FormatError, match="studio, white"):
        render_frame(person, 0, background="#12")


def test_the_shadow_of_a_foot_is_beneath_it_and_lines_stay_where_they_are(person):
    from physxnet_jax.viewer._studio import _GRID, _PIXELS, _REACH, Studio

    studio = Studio(person, (64, 64))
    studio.close()
    pixel = 2 * _REACH / _PIXELS
    lowest = person[0].positions[5][np.argmin(person[0].positions[5][:, 1])]
    centre = np.array([0.3, 0.0, -0.2])
    picture = studio._floor_picture(5, centre).astype(int)
    column, row = ((lowest - centre)[[0, 2]] / pixel + _PIXELS / 2).astype(int)
    assert picture[row, column, 3] > 60 and picture[2, 2, 3] == 0
    # A line is where a coordinate is a multiple of the grid's; half a grid on there is none.
    # Rows and columns here are far from the feet, whose shadow would hide them.
    row = _PIXELS // 2 + round((1.0 - centre[2]) / pixel)
    between = _PIXELS // 2 + round((1.0 + 0.5 * _GRID - centre[2]) / pixel)
    middle = _PIXELS // 2 + round((0.5 * _GRID - centre[0]) / pixel)
    assert picture[row - 1 : row + 2, middle, 3].max() > 8
    assert picture[between - 1 : between + 2, middle, 3].max() < 4
    moved = studio._floor_picture(5, centre + [0.0, 0.0, _GRID]).astype(int)
    assert moved[row - 1 : row + 2, middle, 3].max() > 8


def test_the_renderer_is_loaded_in_a_thread(monkeypatch):
    """Where it is missing, whoever draws says so, not the thread."""

    def thread():
        (found,) = (t for t in threading.enumerate() if t.name == "load the renderer")
        return found

    missing, started = threading.Event(), threading.Event()

    def fail(name):
        assert name == "pyvista"
        started.set()
        missing.wait(10)
        raise ImportError(name)

    monkeypatch.setattr("importlib.import_module", fail)
    load_renderer()
    assert started.wait(10)
    running = thread()
    assert running.daemon
    missing.set()
    running.join(10)
    assert not running.is_alive()


@pytest.mark.release
def test_colours_stay_with_their_garment():
    def colours(wear):
        return {m.name: m.colour for m in dress("walk", wear, method="lbs", frames=1).garments}

    both = colours(["bottom", "top"])
    assert colours(["top", "bottom"]) == both
    assert colours(["bottom"])["bottom"] == both["bottom"]
    two = list(colours(["top", "top"]).values())
    assert two[0] != two[1]


def test_a_picture_is_one_moment_or_a_strip(person, tmp_path):
    import imageio.v3 as iio

    for strip, width in ((1, 160), (3, 480)):
        path = render_preview(tmp_path / "a.png", person, 30.0, size=(160, 192), strip=strip)
        assert np.asarray(iio.imread(path)).shape == (192, width, 3)
    for wrong in ({"strip": 0}, {"size": (8, 192)}, {"size": (99999, 192)}):
        with pytest.raises(FormatError, match=r"strip|size"):
            render_preview(tmp_path / "b.png", person, 30.0, **wrong)
    with pytest.raises(FormatError, match="multiples of 16"):
        render_preview(tmp_path / "b.mp4", person, 30.0, size=(100, 192))


@pytest.mark.release
# imageio's own reader leaves ffmpeg's pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_rendered_frames_show_a_dressed_body(tmp_path):
    clip = dress("walk", ["bottom"], method="lbs", frames=4)
    image = render_frame(clip.meshes, 2, size=(160, 192))
    assert image.shape == (192, 160, 3)
    assert 0.005 < cloth(image).mean() < 0.7, "no dark trousers in the picture"
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
    assert cloth(sheet)[:192].mean() > 5 * cloth(sheet)[192:].mean(), "trousers in one row alone"
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
