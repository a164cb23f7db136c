"""Pictures of the viewer for the documents, from a real browser.

Command: python experiments/picture_viewer.py
Needs:   Chromium on the path.
Cost:    two minutes.
Result:  docs/viewer-network.png, docs/viewer-maps.png, docs/viewer-error.png.
"""

import pathlib
import runpy
import tempfile
import time

import imageio.v3 as iio
import numpy as np

from physxnet_jax.viewer import Choice, Viewer

DOCS = pathlib.Path(__file__).parents[1] / "docs"
_SCENE_FILE_KEYS = runpy.run_path(str(DOCS.parent / "tests/browser.py"))
# The browser's warning that it draws without a GPU says nothing of the viewer.
_CLOSE = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"


def main() -> None:
    choice = Choice("walk", ("top", "bottom"), weights="small+relax", frames=60, live=True)
    viewer = Viewer(choice)
    viewer.wait()
    viewer.controls.playing.value = False
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        page = _SCENE_FILE_KEYS["Page"](viewer.url, folder, (1280, 800))
        page.until("document.querySelector('canvas') !== null")
        time.sleep(8)

        def shoot(name: str, frame: int, scroll: int = 0) -> None:
            viewer.wait()
            viewer.controls.frame.value = frame
            page.run(_CLOSE)
            page.run(
                "document.querySelectorAll('div').forEach(d => {if (d.scrollHeight >"
                f" d.clientHeight + 50) d.scrollTop = {scroll}}})"
            )
            time.sleep(5)
            iio.imwrite(DOCS / f"viewer-{name}.png", page.picture().astype(np.uint8))

        for frame in range(50):
            viewer.controls.frame.value = frame
        shoot("network", 20)
        viewer.controls.settings["live"].value = False
        viewer.controls.worn["top"].value = viewer.controls.worn["bottom"].value = False
        viewer.controls.worn["dress"].value = True
        viewer.controls.show_maps.value = True
        shoot("maps", 25, 700)
        viewer.controls.show_maps.value = False
        viewer.controls.settings["compare"].value = True
        shoot("error", 30)
        page.close()
    viewer.close()


if __name__ == "__main__":
    main()
