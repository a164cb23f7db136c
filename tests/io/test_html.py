"""The page that plays a clip: whole by itself, and in a browser where there is one."""

import base64
import hashlib
import http.server
import json
import pathlib
import re
import runpy
import threading
import time

import numpy as np
import pytest

from physxnet_jax.io import AnimatedMesh, write_clip

pytest.importorskip("pygltflib")

_BROWSER = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "browser.py"))


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


def test_html_page_is_self_contained_and_escaped(page):
    text = page.read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="data" type="application/json">(.*?)</script>', text)[1])
    assert data["frames"] == 3 and list(data["meshes"]) == ["grows</script>", "stays"]
    assert "<title>a &lt;b&gt;</title>" in text
    # One element of each kind opens and closes: no text breaks out of its own.
    assert len(re.findall(r"<script\b", text)) >= len(re.findall(r"</script>", text)) == 3
    outside = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert not re.search(r"(src|href)=.https?:", outside)
    assert "__" not in outside


POLICY = re.compile(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">\n')


def test_the_policy_names_the_scripts_of_the_page_alone(page):
    text = page.read_text(encoding="utf-8")
    policy = POLICY.search(text)[1]
    allowed = policy.partition("script-src ")[2].split()
    scripts = re.findall(r'<script type="module">(.*?)</script>', text, flags=re.S)
    digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    assert allowed == [f"'sha256-{d}'" for d in digests] and len(allowed) == 2
    assert policy.startswith("default-src 'none'") and "http" not in policy
    # Handlers in attributes would not run.
    assert not re.search(r"<[^>]* on\w+=", re.sub(r"<script.*?</script>", "", text, flags=re.S))


@pytest.mark.browser
@pytest.mark.skipif(_BROWSER["BROWSER"] is None, reason="no Chromium installed")
def test_foreign_scripts_and_requests_are_stopped(page, tmp_path):
    asked = []

    class Seen(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, *_):
            pass

    text = page.read_text(encoding="utf-8")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Seen) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        at = f"http://127.0.0.1:{server.server_port}"
        added = "<script>document.body.dataset.intruder = 'ran'</script>"
        tab = _BROWSER["Page"]("about:blank", tmp_path / "profile", (480, 360))
        ran = {}
        try:
            for name, whole in (("held", text), ("open", POLICY.sub("", text))):
                foreign = f"{added}<img src='{at}/{name}'></body>"
                (tmp_path / f"{name}.html").write_text(whole.replace("</body>", foreign))
                tab.call("Page.navigate", url=(tmp_path / f"{name}.html").as_uri())
                tab.until("document.body && document.body.dataset.state === 'loaded'")
                ran[name] = tab.run("document.body.dataset.intruder || null")
        finally:
            tab.close()
            server.shutdown()
    assert ran == {"held": None, "open": "ran"} and asked == ["/open"]


@pytest.mark.release
@pytest.mark.browser
@pytest.mark.skipif(_BROWSER["BROWSER"] is None, reason="no Chromium installed")
def test_html_page_plays_in_a_browser(page, tmp_path):
    tab = _BROWSER["Page"]("about:blank", tmp_path / "profile", (480, 360))

    def red(fragment: str, enough) -> int:
        """Red pixels once there are enough: drawing takes a while on a busy machine."""
        tab.call("Page.navigate", url="about:blank")
        tab.call("Page.navigate", url=f"{page.as_uri()}#{fragment}")
        end = time.monotonic() + 90
        while True:
            time.sleep(1)
            picture = tab.picture()[:300]
            count = int(((picture[..., 0] - picture[..., 1:].max(axis=-1)) > 60).sum())
            # Without the other mesh too there would be nothing but the page's ground.
            if (enough(count) and picture.std() > 5) or time.monotonic() > end:
                return count

    try:
        first = red("frame=0", lambda n: n > 500)
        assert first > 500
        last = red("frame=2", lambda n: n > 1.5 * first)
        assert last > 1.5 * first, "the mesh on the page grows"
        hidden = red("frame=2&without=grows%3C/script%3E", lambda n: n < 0.02 * last)
        assert hidden < 0.02 * last, "and can be taken off"
    finally:
        tab.close()
