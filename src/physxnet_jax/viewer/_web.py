"""The viewer in the browser: choose, play, compare, export."""

import contextlib
import dataclasses
import html
import io
import pathlib
import re
import tempfile
import threading
import time
import traceback
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..body import load_body
from ..dressing import METHODS, Inference
from ..errors import FormatError, PhysXNetError
from ..files import atomic_write
from ..garment import FABRICS, TEMPLATES
from ..io import EXTENSIONS, GARMENT_FORMATS, GltfFile, write_clip
from ..models import list_weights
from ..motion import CLIPS
from ..simulation import PRESETS
from ._job import Choice, Shown, check_choice, run_job
from ._maps import magnified
from ._server import start_server
from ._stage import Stage

_MOTIONS = (".bvh", ".amc", ".npz", ".pkl", ".glb", ".gltf", ".vrma")
_MAP_SIZE = 192


class _Superseded(Exception):
    """A newer choice has replaced this one."""


class Viewer:
    """A web page on which a person is dressed.

    All browsers share one page. The latest choice is computed in the background; the
    previous result stays visible until the new one is ready.

    Args:
        choice: Initial settings.
        host: Address to listen on; by default only this machine can connect.
        port: Port to listen on; the next free one is used.

    Raises:
        MissingDependencyError: Without the ``viewer`` extra.
    """

    def __init__(self, choice: Choice, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        check_choice(choice)
        self.server = start_server(host, port)
        self.shown: Shown | None = None
        self._stage: Stage | None = None
        self._lock = threading.RLock()
        self._requested: Choice | None = None
        self._settled: Choice | None = None
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._folder = tempfile.TemporaryDirectory(prefix="physxnet-view-")
        self._files: dict[str, pathlib.Path] = {}
        self._initial = choice
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
        """Address of the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def chosen(self) -> Choice:
        """The settings of the page's controls."""
        w = self._widgets
        body = load_body()
        defaults = dict(zip(body.shape_names, np.asarray(body.default_shape()), strict=True))
        shape = tuple(
            (name, float(handle.value))
            for name, handle in self._shapes.items()
            if abs(handle.value - defaults[name]) > 1e-6
        )
        motion = str(w["motion"].value)
        motion = str(self._files.get(motion, motion))
        first = self._initial
        # Options of the first motion file don't apply to another one.
        known = motion == str(pathlib.Path(first.motion))
        height = first.simulation.wind[1] if first.simulation.wind else 0.0
        wind = (float(w["wind_x"].value), height, float(w["wind_z"].value))
        return dataclasses.replace(
            first,
            motion=motion,
            source_fps=first.source_fps if known else None,
            skeleton=first.skeleton if known else None,
            joint_map=first.joint_map if known else None,
            wear=self._wear(),
            method=w["method"].value,
            inference=Inference(
                weights=w["weights"].value,
                tta=w["tta"].value,
                strain_iterations=self._iterations if w["strain"].value else 0,
                collisions=w["collisions"].value,
            ),
            compare=w["compare"].value,
            live=w["live"].value,
            shape=shape,
            fabric=None if w["fabric"].value == "as cut" else w["fabric"].value,
            simulation=dataclasses.replace(
                first.simulation,
                accuracy=w["accuracy"].value,
                wind=wind if any(wind) else None,
                self_contact=w["self_contact"].value,
            ),
            frames=int(w["frames"].value),
        )

    def _wear(self) -> tuple[str, ...]:
        """The ticked garments in command-line order: of one type, later ones are outer."""
        ticked = [str(self._files.get(n, n)) for n, box in self._worn.items() if box.value]
        return tuple(sorted(ticked, key=[*self._initial.wear, *ticked].index))

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
        """Adds an uploaded motion or garment.

        Raises:
            FormatError: The file is of another kind.
        """
        # Only the last part, in plain characters: an uploaded name must not act as a path.
        name = re.sub(r"[^\w.-]", "_", pathlib.PurePosixPath(name.replace("\\", "/")).name)
        suffix = pathlib.Path(name).suffix.lower()
        if suffix not in (*_MOTIONS, *GARMENT_FORMATS, ".asf") or name.startswith("."):
            raise FormatError(
                f"{name}: neither a motion ({', '.join(_MOTIONS)}) nor a garment"
                f" ({', '.join(GARMENT_FORMATS)})."
            )
        path = pathlib.Path(self._folder.name) / name
        with atomic_write(path) as part:
            part.write_bytes(content)
        if suffix == ".asf":
            # The AMC file that needs it may already be there.
            self.ask()
            return
        # A glTF file without animations is a garment.
        moves = suffix in _MOTIONS
        if moves and suffix in GARMENT_FORMATS:
            moves = bool(GltfFile(path).document.animations)
        self._files[name] = path
        if not moves:
            with self._lock, self._clothes:
                self._add_garment(name, True)
        else:
            menu = self._widgets["motion"]
            menu.options = tuple(dict.fromkeys((*menu.options, name)))
            menu.value = name
        self.ask()

    def export(self, suffix: str) -> tuple[str, bytes]:
        """Exports what is shown in this format; several files as one ZIP archive.

        Returns:
            Name and content of the file.
        """
        shown = self.wait()
        with tempfile.TemporaryDirectory() as folder:
            name = pathlib.Path(shown.choice.motion).stem.replace(" ", "_")
            out = pathlib.Path(folder) / f"{name}{suffix}"
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
        server = self.server
        gui = server.gui
        gui.configure_theme(control_width="large", dark_mode=False)
        gui.set_panel_label("physxnet")
        self._status = gui.add_markdown("loading …")
        self._failed: PhysXNetError | None = None
        w: dict[str, Any] = {}
        with gui.add_folder("Motion"):
            clips = tuple(CLIPS)
            if choice.motion not in clips:
                name = pathlib.Path(choice.motion).name
                self._files[name] = pathlib.Path(choice.motion)
                clips, first = (*clips, name), name
            else:
                first = choice.motion
            w["motion"] = gui.add_dropdown("clip", clips, initial_value=first)
            w["frames"] = gui.add_slider("max frames", 1, max(600, choice.frames), 1, choice.frames)
            upload = gui.add_upload_button("add motion or garment")
        self._clothes = gui.add_folder("Garments")
        self._worn: dict[str, Any] = {}
        with self._clothes:
            for name in dict.fromkeys((*TEMPLATES, *choice.wear)):
                short = name
                if name not in TEMPLATES:
                    path = pathlib.Path(name)
                    # Files of the same name are distinguished by their paths.
                    short = name if path.name in self._files else path.name
                    self._files[short] = path
                self._add_garment(short, name in choice.wear)
        with gui.add_folder("Cloth"):
            w["method"] = gui.add_dropdown("method", METHODS, initial_value=choice.method)
            name, inference = str(choice.inference.weights), choice.inference
            self._iterations = inference.strain_iterations or Inference().strain_iterations
            w["weights"] = gui.add_dropdown(
                "network", tuple(dict.fromkeys((*list_weights(), name))), initial_value=name
            )
            w["tta"] = gui.add_checkbox("average with mirrored pose", inference.tta)
            w["strain"] = gui.add_checkbox("limit strain", inference.strain_iterations > 0)
            w["collisions"] = gui.add_checkbox("resolve collisions", inference.collisions)
            w["compare"] = gui.add_checkbox("compare with simulation", choice.compare)
            w["live"] = gui.add_checkbox("live inference", choice.live)
            self._pace = gui.add_markdown("", visible=False)
        simulation = choice.simulation
        wind = simulation.wind or (0.0, 0.0, 0.0)
        strongest = max(10.0, *map(abs, wind))
        wind_range = (-strongest, strongest, 0.5)
        with gui.add_folder("Simulation", expand_by_default=False):
            w["accuracy"] = gui.add_dropdown(
                "accuracy", tuple(PRESETS), initial_value=simulation.accuracy
            )
            w["fabric"] = gui.add_dropdown(
                "fabric", ("as cut", *FABRICS), initial_value=choice.fabric or "as cut"
            )
            w["wind_x"] = gui.add_slider("wind from the right, m/s", *wind_range, wind[0])
            w["wind_z"] = gui.add_slider("wind from behind, m/s", *wind_range, wind[2])
            w["self_contact"] = gui.add_checkbox("self-contact", simulation.self_contact)
        self._shapes: dict[str, Any] = {}
        body, overrides = load_body(), dict(choice.shape)
        with gui.add_folder("Body", expand_by_default=False):
            for name, x in zip(body.shape_names, np.asarray(body.default_shape()), strict=True):
                value = round(overrides.get(name, float(x)), 2)
                self._shapes[name] = gui.add_slider(
                    name.replace("_", " "), min(0.0, value), max(1.0, value), 0.05, value
                )
        with gui.add_folder("Play"):
            self._playing = gui.add_checkbox("play", True)
            self._frame = gui.add_slider("frame", 0, max(choice.frames - 1, 1), 1, 0)
            self._show_maps = gui.add_checkbox("network maps", False)
            self._maps_folder = gui.add_folder("Maps", visible=False)
        with gui.add_folder("Export"):
            kind = gui.add_dropdown("format", tuple(EXTENSIONS), initial_value=".usdc")
            export_button = gui.add_button("export")
        self._widgets = w
        for handle in (*w.values(), *self._shapes.values()):
            handle.on_update(lambda _: self._ask_or_report())
        self._frame.on_update(lambda _: self._show_frame())
        self._show_maps.on_update(lambda _: self._show_frame())

        @upload.on_upload
        def _(event: Any) -> None:
            with self._reporting_errors():
                self.add_file(event.target.value.name, event.target.value.content)

        @export_button.on_click
        def _(event: Any) -> None:
            export_button.disabled = True
            try:
                with self._reporting_errors():
                    event.client.send_file_download(*self.export(kind.value))
            finally:
                export_button.disabled = False

    def _add_garment(self, name: str, worn: bool) -> None:
        if name in self._worn:
            self._worn[name].value = worn
            return
        box = self.server.gui.add_checkbox(name, worn)
        box.on_update(lambda _: self._ask_or_report())
        self._worn[name] = box

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
        self._status.content = "**" + re.sub(r"([\\`*_{}\[\]()#!|])", r"\\\1", text) + "**"

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
                self._status.content = shown.summary
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
        self._status.content = f"{stage}: {done} of {total} frames …"

    def _display(self, shown: Shown) -> None:
        with self._lock, self.server.atomic():
            if self._stage is not None:
                self._stage.clear()
                self._stage = None
            self.shown, self._stage = shown, Stage(self.server.scene, shown)
            self._frame.max = max(shown.num_frames - 1, 1)
            self._show_frame()

    def _show_frame(self) -> None:
        with self._lock:
            if self._stage is None or self.shown is None:
                return
            frame = min(int(self._frame.value), self.shown.num_frames - 1)
            live = self.shown.live
            worn = None if live is None else live.frame(frame)
            with self.server.atomic():
                self._stage.show(frame, worn)
            self._pace.visible = live is not None
            # A number that changes with every frame would be unreadable.
            if live is not None and frame % 10 == 0:
                self._pace.content = f"{live.milliseconds:.1f} ms a frame, live"
            # While playing, maps are drawn every tenth frame: they cost more than the frame.
            if self._show_maps.value != self._maps_folder.visible:
                self._maps_folder.visible = self._show_maps.value
            if self._show_maps.value and (not self._playing.value or frame % 10 == 0):
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
                with self._maps_folder:
                    self._pictures[name] = self.server.gui.add_image(picture, label=name)

    def _play(self) -> None:
        due = time.monotonic()
        while not self._closed.is_set():
            shown = self.shown
            if shown is None or not self._playing.value or not self.server.get_clients():
                self._closed.wait(0.1)
                due = time.monotonic()
                continue
            try:
                # Setting the slider shows the frame.
                self._frame.value = (int(self._frame.value) + 1) % shown.num_frames
            except Exception as error:
                # A frame that can't be shown stops playback, but not this thread.
                self._report_error(error)
                self._playing.value = False
            due = max(due + 1.0 / shown.clip.fps, time.monotonic() - 1.0)
            self._closed.wait(max(due - time.monotonic(), 0.0))
