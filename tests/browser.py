"""A headless Chromium, driven through its debugging port."""

import base64
import contextlib
import io
import itertools
import json
import pathlib
import shutil
import subprocess
import time
import urllib.request

import numpy as np

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


class Page:
    """A tab of it.

    Args:
        url: What it opens.
        folder: Where the browser keeps its things.
        size: Width and height of the window.
    """

    def __init__(self, url, folder, size=(900, 700)):
        from websockets.sync.client import connect

        words = "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader"
        words += f" --enable-unsafe-swiftshader --user-data-dir={folder}"
        # It chooses a free port and writes it down.
        self.browser = subprocess.Popen(
            [BROWSER, *words.split(), "--remote-debugging-port=0", url],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = pathlib.Path(folder) / "DevToolsActivePort"
        for _ in range(300):
            with contextlib.suppress(OSError, IndexError):
                port = port_file.read_text().split()[0]
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=5) as answer:
                    tabs = [t for t in json.load(answer) if t["type"] == "page"]
                break
            time.sleep(0.2)
        self.count = itertools.count(1)
        self.socket = connect(tabs[0]["webSocketDebuggerUrl"], max_size=None)
        width, height = size
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def call(self, method, **parameters):
        number = next(self.count)
        self.socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self.socket.recv(timeout=120))
            if answer.get("id") == number:
                return answer["result"]

    def run(self, script):
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return answer["result"].get("value")

    def until(self, script, seconds=90):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self.run(script):
                return
            time.sleep(0.5)
        raise AssertionError(f"the page never said: {script}")

    def picture(self):
        from PIL import Image

        data = self.call("Page.captureScreenshot", format="png")["data"]
        image = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
        return np.asarray(image, np.float32)

    def close(self):
        self.socket.close()
        self.browser.terminate()
        self.browser.wait(30)
