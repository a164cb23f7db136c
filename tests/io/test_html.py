"""The page that plays a clip: whole by itself, and in a browser where there is one."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from physxnet_jax.io import AnimatedMesh, write_clip

pytest.importorskip("pygltflib")

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@pytest.fixture
def page(tmp_path):
    """A tetrahedron that grows to twice its size, beside one that stays."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    grow = np.stack([x * s for s in (1.0, 1.5, 2.0)])
    meshes = [
        AnimatedMesh("grows</script>", grow, faces, colour=(1.0, 0.0, 0.0)),
        AnimatedMesh("stays", np.repeat(x[None] - [1.5, 0, 0], 3, 0).astype(np.float32), faces),
    ]
    (path,) = write_clip(tmp_path / "a <b>.html", meshes, 10.0)
    return path


def test_it_holds_all_it_needs(page):
    text = page.read_text(encoding="utf-8")
    told = json.loads(re.search(r'id="told" type="application/json">(.*?)</script>', text)[1])
    assert told["frames"] == 3 and list(told["meshes"]) == ["grows</script>", "stays"]
    assert "<title>a &lt;b&gt;</title>" in text
    # One element of each kind opens and closes: no text breaks out of its own.
    assert len(re.findall(r"<script\b", text)) >= len(re.findall(r"</script>", text)) == 3
    outside = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert not re.search(r"(src|href)=.https?:", outside)
    assert "__" not in outside


@pytest.mark.browser
@pytest.mark.skipif(BROWSER is None, reason="no Chromium installed")
def test_it_plays_in_a_browser(page, tmp_path):
    from PIL import Image

    def shot(fragment: str) -> np.ndarray:
        out = tmp_path / f"{len(list(tmp_path.iterdir()))}.png"
        words = "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader"
        words += " --enable-unsafe-swiftshader --window-size=480,360 --virtual-time-budget=8000"
        words += f" --user-data-dir={tmp_path / 'profile'}"
        url = f"{page.as_uri()}#{fragment}"
        command = [BROWSER, *words.split(), f"--screenshot={out}", url]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        return np.asarray(Image.open(out).convert("RGB"), float)[:300]

    def red(picture: np.ndarray) -> int:
        return int(((picture[..., 0] - picture[..., 1:].max(axis=-1)) > 60).sum())

    first, last, hidden = (
        shot(f) for f in ("frame=0", "frame=2", "frame=2&without=grows%3C/script%3E")
    )
    assert red(first) > 500
    assert red(last) > 1.5 * red(first), "the mesh on the page grows"
    assert red(hidden) < 0.02 * red(last), "and can be taken off"
