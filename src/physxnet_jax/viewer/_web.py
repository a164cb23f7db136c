"""The viewer in the browser: choose, play, compare, export."""

import contextlib
import html
import io
import pathlib
import re
import socket
import tempfile
import threading
import time
import traceback
import zipfile
from collections.abc import Iterator
from typing import Any

from ..dressing import write_dressed_character
from ..errors import FormatError, PhysXNetError
from ..io import EXTENSIONS, write_clip
from ._controls import Controls
from ._guard import Guard
from ._job import Choice, Shown, check_choice, run_job
from ._maps import magnified
from ._server import start_server
from ._stage import Stage

_MAP_SIZE = 192


class _Superseded(Exception):
    """A newer choice has replaced this one."""


class Viewer:
    """A web page on which a person is dressed.

    All browsers share one page. The latest choice is computed in the background; the
    previous result stays visible until the new one is ready.

    Args:
        choice: Initial settings.
        host: Address to listen on; by default only this machine can connect. Anyone needs
            the token in `url`.
        port: Port to listen on; the next free one is used.

    Raises:
        MissingDependencyError: Without the ``viewer`` extra.
    """

    def __init__(self, choice: Choice, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        check_choice(choice)
        self._guard = Guard(host, lambda text: self._report_error(PhysXNetError(text)))
        self.server = start_server(host, port, self._guard)
        self.shown: Shown | None = None
        self._stage: Stage | None = None
        self._lock = threading.RLock()
        self._requested: Choice | None = None
        self._settled: Choice | None = None
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._folder = tempfile.TemporaryDirectory(prefix="physxnet-view-")
        self._pictures: dict[str, Any] = {}
        self._build(choice)
        self._threads = [
            threading.Thread(target=run, daemon=True) for run in (self._compute, self._play)
        ]
        for thread in self._threads:
            thread.start()
        self.ask()

    @property
    def url(self) -> str:
        """Address of the page, with the token that it needs."""
        host = self.server.get_host()
        if host in ("0.0.0.0", "::"):
            host = socket.gethostname()
        if ":" in host:
            host = f"[{host}]"
        return f"http://{host}:{self.server.get_port()}/?token={self._guard.token}"

    def chosen(self) -> Choice:
        """The settings of the page's controls.

        Raises:
            PhysXNetError: A control holds a value that it doesn't offer.
        """
        with self._lock:
            return self.controls.choice()

    def ask(self) -> None:
        """Requests the computation of the current settings."""
        with self._lock:
            self._requested = self.chosen()
            self._wake.set()

    def _ask_or_report(self) -> None:
        with self._reporting_errors():
            self.ask()

    def wait(self, seconds: float = 600.0) -> Shown:
        """Waits until the current settings are shown.

        Raises:
            PhysXNetError: The computation failed or takes too long.
        """
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with self._lock:
                # A control changes shortly before its callback requests the computation.
                settled = self._requested is None and self._settled == self.chosen()
                if settled and not self._wake.is_set():
                    if self._failed is not None:
                        raise self._failed
                    if self.shown is not None:
                        return self.shown
            time.sleep(0.02)
        raise PhysXNetError(f"Nothing to show after {seconds:g} seconds.")

    def add_file(self, name: str, content: bytes) -> None:
        """Adds an uploaded motion, garment, character or fabric.

        Raises:
            FormatError: The file is of another kind.
            PhysXNetError: Too much has been uploaded.
        """
        with self._lock:
            self.controls.add_file(name, content)
        self.ask()

    def export(self, suffix: str) -> tuple[str, bytes]:
        """Exports what is shown in this format; several files as one ZIP archive.

        Returns:
            Name and content of the file.

        Raises:
            FormatError: There is no such format.
        """
        if suffix not in EXTENSIONS:
            raise FormatError(f"No format '{suffix}'; there are {', '.join(EXTENSIONS)}.")
        shown = self.wait()
        with tempfile.TemporaryDirectory() as folder:
            name = re.sub(r"[^\w.-]", "_", pathlib.Path(shown.choice.motion).stem)
            out = pathlib.Path(folder) / f"{name}{suffix}"
            person = shown.character
            if suffix == ".glb" and person is not None and person.rig is not None:
                written = [write_dressed_character(out, person, shown.garments)]
            else:
                written = write_clip(out, shown.meshes(), shown.clip.fps)
            if len(written) == 1:
                return written[0].name, written[0].read_bytes()
            archive = pathlib.Path(folder) / f"{name}.zip"
            with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
                for path in written:
                    file.write(path, path.name)
            return archive.name, archive.read_bytes()

    def close(self) -> None:
        """Stops the page and the running computation."""
        self._closed.set()
        self._wake.set()
        for thread in self._threads:
            thread.join(timeout=30.0)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        self._folder.cleanup()

    def _build(self, choice: Choice) -> None:
        gui = self.server.gui
        gui.configure_theme(control_width="large", dark_mode=False, show_share_button=False)
        gui.set_panel_label("physxnet")
        self._failed: PhysXNetError | None = None
        self.controls = c = Controls(gui, choice, pathlib.Path(self._folder.name))
        c.on_change(self._ask_or_report)
        c.frame.on_update(lambda _: self._show_frame())
        c.show_maps.on_update(lambda _: self._show_frame())

        @c.upload.on_upload
        def _(event: Any) -> None:
            with self._reporting_errors():
                self.add_file(event.target.value.name, event.target.value.content)

        @c.export.on_click
        def _(event: Any) -> None:
            c.export.disabled = True
            try:
                with self._reporting_errors():
                    event.client.send_file_download(*self.export(c.format.value))
            finally:
                c.export.disabled = False

    @contextlib.contextmanager
    def _reporting_errors(self) -> Iterator[None]:
        """Shows errors of the user's actions on the page."""
        try:
            yield
        except (PhysXNetError, OSError) as error:
            self._report_error(error)

    def _report_error(self, error: Exception) -> None:
        """Shows an error as plain text: it may quote a file, and the page renders HTML."""
        text = html.escape(str(error))
        self.controls.status.content = "**" + re.sub(r"([\\`*_{}\[\]()#!|])", r"\\\1", text) + "**"

    def _compute(self) -> None:
        while True:
            self._wake.wait()
            with self._lock:
                self._wake.clear()
                choice = self._requested
            if self._closed.is_set():
                return
            if choice is None:
                continue
            failed: PhysXNetError | None = None
            try:
                shown = run_job(choice, self._report_progress)
                self._display(shown)
                self.controls.status.content = shown.summary
            except _Superseded:
                continue
            except PhysXNetError as error:
                failed = error
            except Exception as error:
                traceback.print_exc()
                failed = PhysXNetError(f"{type(error).__name__}: {error}")
            if failed is not None:
                self._report_error(failed)
            with self._lock:
                self._failed, self._settled = failed, choice
                if not self._wake.is_set():
                    self._requested = None

    def _report_progress(self, stage: str, done: int, total: int) -> None:
        if self._wake.is_set() or self._closed.is_set():
            raise _Superseded
        self.controls.status.content = f"{stage}: {done} of {total} frames …"

    def _display(self, shown: Shown) -> None:
        with self._lock, self.server.atomic():
            if self._stage is not None:
                self._stage.clear()
                self._stage = None
            self.shown, self._stage = shown, Stage(self.server.scene, shown)
            self.controls.frame.max = max(shown.num_frames - 1, 1)
            self._show_frame()

    def _show_frame(self) -> None:
        with self._lock:
            if self._stage is None or self.shown is None:
                return
            frame = min(int(self.controls.frame.value), self.shown.num_frames - 1)
            live = self.shown.live
            worn = None if live is None else live.frame(frame)
            with self.server.atomic():
                self._stage.show(frame, worn)
            self.controls.pace.visible = live is not None
            # A number that changes with every frame would be unreadable.
            if live is not None and frame % 10 == 0:
                self.controls.pace.content = f"{live.milliseconds:.1f} ms a frame, live"
            # While playing, maps are drawn every tenth frame: they cost more than the frame.
            if self.controls.show_maps.value != self.controls.maps.visible:
                self.controls.maps.visible = self.controls.show_maps.value
            if self.controls.show_maps.value and (
                not self.controls.playing.value or frame % 10 == 0
            ):
                self._draw_maps(self.shown, frame)

    def _draw_maps(self, shown: Shown, frame: int) -> None:
        pictures = shown.maps(frame)
        for name in self._pictures.keys() - pictures.keys():
            self._pictures.pop(name).remove()
        for name, picture in pictures.items():
            picture = magnified(picture, _MAP_SIZE)
            if name in self._pictures:
                self._pictures[name].image = picture
            else:
                with self.controls.maps:
                    self._pictures[name] = self.server.gui.add_image(picture, label=name)

    def _play(self) -> None:
        due = time.monotonic()
        while not self._closed.is_set():
            shown = self.shown
            if shown is None or not self.controls.playing.value or not self.server.get_clients():
                self._closed.wait(0.1)
                due = time.monotonic()
                continue
            try:
                # Setting the slider shows the frame.
                self.controls.frame.value = (int(self.controls.frame.value) + 1) % shown.num_frames
            except Exception as error:
                # A frame that can't be shown stops playback, but not this thread.
                self._report_error(error)
                self.controls.playing.value = False
            due = max(due + 1.0 / shown.clip.fps, time.monotonic() - 1.0)
            self._closed.wait(max(due - time.monotonic(), 0.0))
