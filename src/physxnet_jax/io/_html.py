"""A self-contained HTML page that plays a clip: a glTF and its viewer in one file."""

import base64
import hashlib
import html
import itertools
import json
import pathlib
import tempfile
from collections.abc import Sequence

import numpy as np

from ..files import atomic_write
from ._animated_mesh import AnimatedMesh
from ._gltf import write_gltf

_VIEWER = pathlib.Path(__file__).with_name("assets") / "model-viewer.min.js"

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="__POLICY__">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>__TITLE__</title>
<style>
html, body { height: 100%; margin: 0; font: 15px system-ui, sans-serif; background: #f4f4f2; }
body { display: flex; flex-direction: column; }
model-viewer { flex: 1; width: 100%; --poster-color: transparent; }
form { display: flex; flex-wrap: wrap; gap: 1em; align-items: center; padding: .6em 1em; }
input[type=range] { flex: 1; min-width: 10em; }
output { min-width: 9em; font-variant-numeric: tabular-nums; }
button { min-width: 5em; }
</style>
<script type="module">__VIEWER__</script>
</head>
<body>
<model-viewer id="view" camera-controls autoplay interaction-prompt="none" shadow-intensity="0.6"
 tone-mapping="neutral" exposure="0.85" camera-orbit="25deg 80deg __AWAY__m"
 camera-target="__MIDDLE__" field-of-view="30deg" max-camera-orbit="auto auto __FARTHEST__m"
 alt="__TITLE__"><div slot="progress-bar"></div></model-viewer>
<form>
<button type="button" id="play">pause</button>
<input type="range" id="time" min="0" max="__LAST__" value="0" step="1" aria-label="frame">
<output id="shown"></output>
<span id="parts"></span>
</form>
<script id="data" type="application/json">__DATA__</script>
<script type="module">
document.querySelector('form').addEventListener('submit', e => e.preventDefault());
const data = JSON.parse(document.getElementById('data').textContent);
const [view, play, time, shown, parts] =
  ['view', 'play', 'time', 'shown', 'parts'].map(id => document.getElementById(id));
const bytes = Uint8Array.from(atob(data.model), c => c.charCodeAt(0));
view.src = URL.createObjectURL(new Blob([bytes], {type: 'model/gltf-binary'}));
const last = data.frames - 1;
const show = frame => {
  time.value = frame;
  shown.textContent = `frame ${frame} of ${last}, ${(frame / data.fps).toFixed(2)} s`;
};
const stop = frame => {
  view.pause();
  play.textContent = 'play';
  // The very end would wrap to the start.
  view.currentTime = Math.min(frame / data.fps, Math.max(last / data.fps - 1e-4, 0));
  show(frame);
};
const setVisible = (name, visible) => {
  for (const [number, colour] of data.meshes[name]) {
    const material = view.model.materials[number];
    material.setAlphaMode(visible ? 'OPAQUE' : 'MASK');
    material.pbrMetallicRoughness.setBaseColorFactor([...colour, visible ? 1 : 0]);
  }
};
view.addEventListener('load', () => {
  for (const name of Object.keys(data.meshes)) {
    const label = document.createElement('label');
    const box = Object.assign(document.createElement('input'), {type: 'checkbox', checked: true});
    box.addEventListener('change', () => setVisible(name, box.checked));
    label.append(box, ' ', name);
    parts.append(label);
  }
  // page.html#frame=12&without=top opens at a frame, without a mesh.
  const params = new URLSearchParams(location.hash.slice(1));
  for (const name of params.getAll('without')) {
    if (!(name in data.meshes)) continue;
    setVisible(name, false);
    parts.children[Object.keys(data.meshes).indexOf(name)].firstChild.checked = false;
  }
  if (params.has('frame')) {
    stop(Math.min(Math.max(Math.round(+params.get('frame')) || 0, 0), last));
  }
  document.body.dataset.state = 'loaded';
});
view.addEventListener('error', e => { shown.textContent = `can't be shown: ${e.detail.type}`; });
play.addEventListener('click', () => {
  if (view.paused) { view.play(); play.textContent = 'pause'; }
  else stop(Math.round(view.currentTime * data.fps) % data.frames);
});
time.addEventListener('input', () => stop(+time.value));
const follow = () => {
  if (!view.paused && last > 0) show(Math.round(view.currentTime * data.fps) % data.frames);
  requestAnimationFrame(follow);
};
show(0);
follow();
</script>
</body>
</html>
"""


# The last script of the page.
_SCRIPT = _PAGE.rpartition('<script type="module">')[2].partition("</script>")[0]
# Nothing is fetched from anywhere, and no other script runs than the page's own.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src blob: data:; connect-src blob: data:;"
    " base-uri 'none'; form-action 'none'"
)


def _digest(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def write_html(path: str | pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float) -> None:
    """Writes a self-contained HTML page that plays the clip in any browser.

    The page needs no network, and its content policy allows none. The mouse orbits the camera,
    playback can be paused and scrubbed, and every mesh can be hidden. The address
    ``page.html#frame=12&without=top`` opens the page at a frame, without a mesh. The limits
    of `write_gltf` apply.

    Args:
        path: ``.html``; written atomically.
        meshes: Meshes to show, all with the same number of frames.
        fps: Frames per second.

    Raises:
        FormatError: There are too many frames.
        MissingDependencyError: pygltflib isn't installed.
    """
    path = pathlib.Path(path)
    with tempfile.TemporaryDirectory(prefix="physxnet_") as folder:
        model = pathlib.Path(folder) / "clip.glb"
        write_gltf(model, meshes, fps)
        contents = {
            "frames": len(meshes[0].positions),
            "fps": fps,
            "meshes": _materials(meshes),
            "model": base64.b64encode(model.read_bytes()).decode(),
        }
    # The bounding sphere of the clip fills the field of view of 30 degrees.
    low = np.min([m.positions.min(axis=(0, 1)) for m in meshes], axis=0)
    high = np.max([m.positions.max(axis=(0, 1)) for m in meshes], axis=0)
    away = float(np.linalg.norm(high - low)) * 0.5 / np.sin(np.radians(15.0))
    parts = {
        "__AWAY__": f"{away:.3f}",
        "__FARTHEST__": f"{3 * away:.3f}",
        "__MIDDLE__": " ".join(f"{x:.3f}m" for x in (low + high) / 2),
        "__TITLE__": html.escape(path.stem),
        "__LAST__": str(contents["frames"] - 1),
        # Neither text may close its enclosing element.
        "__DATA__": json.dumps(contents).replace("<", "\\u003c"),
        "__VIEWER__": _VIEWER.read_text(encoding="utf-8").replace("</script", "<\\/script"),
    }
    viewer, own = (_digest(text) for text in (parts["__VIEWER__"], _SCRIPT))
    page = _PAGE.replace("__POLICY__", f"{_POLICY}; script-src {viewer} {own}")
    for name, text in parts.items():
        page = page.replace(name, text)
    with atomic_write(path) as part:
        part.write_text(page, encoding="utf-8")


def _materials(meshes: Sequence[AnimatedMesh]) -> dict[str, list[tuple[int, list[float]]]]:
    """Indices of each mesh's materials in the glTF, and their colours."""
    number = itertools.count()
    return {
        m.name: [(next(number), list(map(float, look.colour))) for look in m.looks] for m in meshes
    }
