"""Pictures of the viewer for the documents, from a real browser.

Command: python experiments/picture_viewer.py
Needs:   Chromium on the path.
Cost:    two minutes.
Result:  docs/viewer-clothes.png, docs/viewer-maps.png, docs/viewer-compare.png.
"""

import pathlib
import runpy
import tempfile
import time

import imageio.v3 as iio
import numpy as np

from physxnet_jax.viewer import Choice, Viewer

DOCS = pathlib.Path(__file__).parents[1] / "docs"
_BROWSER = runpy.run_path(str(DOCS.parent / "tests/browser.py"))
# The browser's warning that it draws without a GPU says nothing of the viewer.
_CLOSE = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"


def main() -> None:
    choice = Choice("walk", ("shirt", "trousers"), frames=60, live=True)
    viewer = Viewer(choice)
    viewer.wait()
    viewer.controls.playing.value = False
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        page = _BROWSER["Page"](viewer.url, folder, (1400, 900))
        page.until("document.querySelector('canvas') !== null")
        time.sleep(8)

        def shoot(name: str, frame: int, tab: str) -> None:
            viewer.wait()
            viewer.controls.frame.value = frame
            page.run(_CLOSE)
            x, y = page.run(
                "(() => {const e = [...document.querySelectorAll('*')].filter(b => b.textContent =="
                f" '{tab}').at(-1).getBoundingClientRect();"
                " return [e.x + e.width / 2, e.y + e.height / 2]})()"
            )
            for kind in ("mousePressed", "mouseReleased"):
                press = {"x": x, "y": y, "button": "left", "clickCount": 1}
                page.call("Input.dispatchMouseEvent", type=kind, **press)
            time.sleep(5)
            iio.imwrite(DOCS / f"viewer-{name}.png", page.picture().astype(np.uint8))

        for frame in range(50):
            viewer.controls.frame.value = frame
        shoot("clothes", 20, "Clothes")
        settings, worn = viewer.controls.settings, viewer.controls.worn
        settings["live"].value = False
        worn["shirt"].value = worn["trousers"].value = False
        worn["dress"].value = True
        viewer.controls.show_maps.value = True
        shoot("maps", 25, "Export")
        viewer.controls.show_maps.value = False
        settings["compare"].value = True
        shoot("compare", 30, "Method")
        page.close()
    viewer.close()


if __name__ == "__main__":
    main()
