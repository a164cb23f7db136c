"""The viewer in a browser: choose, watch, compare, take away."""

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
from ..dressing import METHODS
from ..errors import FormatError, PhysXNetError
from ..files import whole_file
from ..garment import FABRICS, TEMPLATES
from ..io import (
    EXTENSIONS,
    GARMENT_FORMATS,
    MIRROR,
    RELAX,
    list_weights,
    split_ways,
    write_clip,
)
from ..motion import CLIPS, GltfFile
from ..simulation import ACCURACY
from ._job import Choice, Shown, carry_out, check_choice
from ._maps import magnified
from ._server import start_server
from ._stage import Stage

_MOTIONS = (".bvh", ".amc", ".npz", ".glb", ".gltf", ".vrma")
_MAP_SIZE = 192


class _Superseded(Exception):
    """Something else has been chosen meanwhile."""


class Viewer:
    """A web page on which a person is dressed.

    The page is one for all who look at it. What is chosen is computed in the background,
    the latest choice first; what was shown stays until the new one is ready.

    Args:
        choice: What is shown at first.
        host: Address to listen at; by default only this machine can connect.
        port: Port to listen at; the next free one is taken.

    Raises:
        MissingDependencyError: Without the ``viewer`` extra.
    """

    def __init__(self, choice: Choice, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        check_choice(choice)
        self.server = start_server(host, port)
        self.shown: Shown | None = None
        self._stage: Stage | None = None
        self._lock = threading.RLock()
        self._wanted: Choice | None = None
        self._settled: Choice | None = None
        self._news = threading.Event()
        self._over = threading.Event()
        self._folder = tempfile.TemporaryDirectory(prefix="physxnet-view-")
        self._files: dict[str, pathlib.Path] = {}
        self._first = choice
        self._pictures: dict[str, Any] = {}
        self._build(choice)
        self._threads = [
            threading.Thread(target=run, daemon=True) for run in (self._work, self._play)
        ]
        for thread in self._threads:
            thread.start()
        self.ask()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def chosen(self) -> Choice:
        """What the page's controls say."""
        w = self._widgets
        body = load_body()
        ordinary = dict(zip(body.shape_names, np.asarray(body.default_shape()), strict=True))
        shape = tuple(
            (name, float(handle.value))
            for name, handle in self._shapes.items()
            if abs(handle.value - ordinary[name]) > 1e-6
        )
        motion = str(w["motion"].value)
        motion = str(self._files.get(motion, motion))
        first = self._first
        # What was said of one file isn't true of another.
        known = motion == str(pathlib.Path(first.motion))
        return dataclasses.replace(
            first,
            motion=motion,
            source_fps=first.source_fps if known else None,
            skeleton=first.skeleton if known else None,
            joint_map=first.joint_map if known else None,
            wear=self._wear(),
            method=w["method"].value,
            weights="".join((w["weights"].value, *(x for x in (MIRROR, RELAX) if w[x].value))),
            push_out=w["push_out"].value,
            compare=w["compare"].value,
            live=w["live"].value,
            shape=shape,
            accuracy=w["accuracy"].value,
            fabric=None if w["fabric"].value == "as cut" else w["fabric"].value,
            wind=(float(w["wind_x"].value), self._first.wind[1], float(w["wind_z"].value)),
            self_contact=w["self_contact"].value,
            frames=int(w["frames"].value),
        )

    def _wear(self) -> tuple[str, ...]:
        """What is ticked, in the order of the command: of two of one kind the first is beneath."""
        ticked = [str(self._files.get(n, n)) for n, box in self._worn.items() if box.value]
        return tuple(sorted(ticked, key=[*self._first.wear, *ticked].index))

    def ask(self) -> None:
        """Has what is chosen computed."""
        with self._lock:
            self._wanted = self.chosen()
            self._news.set()

    def wait(self, seconds: float = 600.0) -> Shown:
        """Waits until what is chosen is shown.

        Raises:
            PhysXNetError: What went wrong, or that it takes too long.
        """
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with self._lock:
                # A box is ticked a moment before anybody has asked for what it means.
                settled = self._wanted is None and self._settled == self.chosen()
                if settled and not self._news.is_set():
                    if self._failed is not None:
                        raise self._failed
                    if self.shown is not None:
                        return self.shown
            time.sleep(0.02)
        raise PhysXNetError(f"Nothing to show after {seconds:g} seconds.")

    def add_file(self, name: str, content: bytes) -> None:
        """A motion or a garment that was dropped in.

        Raises:
            FormatError: Another kind of file.
        """
        # Only the last part, in plain characters: a name from the net is no path.
        name = re.sub(r"[^\w.-]", "_", pathlib.PurePosixPath(name.replace("\\", "/")).name)
        suffix = pathlib.Path(name).suffix.lower()
        if suffix not in (*_MOTIONS, *GARMENT_FORMATS, ".asf") or name.startswith("."):
            raise FormatError(
                f"{name}: not a motion ({', '.join(_MOTIONS)}) nor a garment"
                f" ({', '.join(GARMENT_FORMATS)})."
            )
        path = pathlib.Path(self._folder.name) / name
        with whole_file(path) as part:
            part.write_bytes(content)
        if suffix == ".asf":
            # The AMC that asked for it may be there already.
            self.ask()
            return
        # A glTF in which nothing moves is a garment.
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
        """What is shown as a file of this format; several as one archive.

        Returns:
            Name and content.
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
        """Ends the page and what is being computed."""
        self._over.set()
        self._news.set()
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
            there = tuple(CLIPS)
            if choice.motion not in there:
                name = pathlib.Path(choice.motion).name
                self._files[name] = pathlib.Path(choice.motion)
                there, first = (*there, name), name
            else:
                first = choice.motion
            w["motion"] = gui.add_dropdown("clip", there, initial_value=first)
            w["frames"] = gui.add_slider(
                "frames at most", 1, max(600, choice.frames), 1, choice.frames
            )
            upload = gui.add_upload_button("add motion or garment")
        self._clothes = gui.add_folder("Garments")
        self._worn: dict[str, Any] = {}
        with self._clothes:
            for name in dict.fromkeys((*TEMPLATES, *choice.wear)):
                short = name
                if name not in TEMPLATES:
                    path = pathlib.Path(name)
                    # Two files of one name are told apart by where they are.
                    short = name if path.name in self._files else path.name
                    self._files[short] = path
                self._add_garment(short, name in choice.wear)
        with gui.add_folder("Cloth"):
            w["method"] = gui.add_dropdown("method", METHODS, initial_value=choice.method)
            name, ways = split_ways(choice.weights)
            w["weights"] = gui.add_dropdown(
                "network", tuple(dict.fromkeys((*list_weights(), name))), initial_value=name
            )
            w[MIRROR] = gui.add_checkbox("mirrored person too", MIRROR in ways)
            w[RELAX] = gui.add_checkbox("lengths of edges", RELAX in ways)
            w["push_out"] = gui.add_checkbox("push out of the body", choice.push_out)
            w["compare"] = gui.add_checkbox("simulation beside it", choice.compare)
            w["live"] = gui.add_checkbox("clothe live, as it plays", choice.live)
            self._pace = gui.add_markdown("", visible=False)
        strongest = max(10.0, *map(abs, choice.wind))
        reach = (-strongest, strongest, 0.5)
        with gui.add_folder("When simulating", expand_by_default=False):
            w["accuracy"] = gui.add_dropdown(
                "accuracy", tuple(ACCURACY), initial_value=choice.accuracy
            )
            w["fabric"] = gui.add_dropdown(
                "fabric", ("as cut", *FABRICS), initial_value=choice.fabric or "as cut"
            )
            w["wind_x"] = gui.add_slider("wind from the right, m/s", *reach, choice.wind[0])
            w["wind_z"] = gui.add_slider("wind from behind, m/s", *reach, choice.wind[2])
            w["self_contact"] = gui.add_checkbox("self-contact", choice.self_contact)
        self._shapes: dict[str, Any] = {}
        body, told = load_body(), dict(choice.shape)
        with gui.add_folder("Body", expand_by_default=False):
            for name, x in zip(body.shape_names, np.asarray(body.default_shape()), strict=True):
                value = round(told.get(name, float(x)), 2)
                self._shapes[name] = gui.add_slider(
                    name.replace("_", " "), min(0.0, value), max(1.0, value), 0.05, value
                )
        with gui.add_folder("Play"):
            self._playing = gui.add_checkbox("play", True)
            self._frame = gui.add_slider("frame", 0, max(choice.frames - 1, 1), 1, 0)
            self._show_maps = gui.add_checkbox("maps of the network", False)
            self._maps_folder = gui.add_folder("Maps", visible=False)
        with gui.add_folder("Take away"):
            kind = gui.add_dropdown("format", tuple(EXTENSIONS), initial_value=".usdc")
            take = gui.add_button("export")
        self._widgets = w
        for handle in (*w.values(), *self._shapes.values()):
            handle.on_update(lambda _: self.ask())
        self._frame.on_update(lambda _: self._show_frame())
        self._show_maps.on_update(lambda _: self._show_frame())

        @upload.on_upload
        def _(event: Any) -> None:
            with self._telling():
                self.add_file(event.target.value.name, event.target.value.content)

        @take.on_click
        def _(event: Any) -> None:
            take.disabled = True
            try:
                with self._telling():
                    event.client.send_file_download(*self.export(kind.value))
            finally:
                take.disabled = False

    def _add_garment(self, name: str, worn: bool) -> None:
        if name in self._worn:
            self._worn[name].value = worn
            return
        box = self.server.gui.add_checkbox(name, worn)
        box.on_update(lambda _: self.ask())
        self._worn[name] = box

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        """Errors of what the user asked for are shown on the page."""
        try:
            yield
        except (PhysXNetError, OSError) as error:
            self._tell(error)

    def _tell(self, error: Exception) -> None:
        """Shows an error as plain text: it may quote a file, and the page takes HTML."""
        text = html.escape(str(error))
        self._status.content = "**" + re.sub(r"([\\`*_{}\[\]()#!|])", r"\\\1", text) + "**"

    def _work(self) -> None:
        while True:
            self._news.wait()
            with self._lock:
                self._news.clear()
                choice = self._wanted
            if self._over.is_set():
                return
            if choice is None:
                continue
            failed: PhysXNetError | None = None
            try:
                shown = carry_out(choice, self._tick)
                self._put(shown)
                self._status.content = shown.told
            except _Superseded:
                continue
            except PhysXNetError as error:
                failed = error
            except Exception as error:
                traceback.print_exc()
                failed = PhysXNetError(f"{type(error).__name__}: {error}")
            if failed is not None:
                self._tell(failed)
            with self._lock:
                self._failed, self._settled = failed, choice
                if not self._news.is_set():
                    self._wanted = None

    def _tick(self, stage: str, done: int, total: int) -> None:
        if self._news.is_set() or self._over.is_set():
            raise _Superseded
        self._status.content = f"{stage}: {done} of {total} frames …"

    def _put(self, shown: Shown) -> None:
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
            # A number that changes with every frame can't be read.
            if live is not None and frame % 10 == 0:
                self._pace.content = f"{live.milliseconds:.1f} ms a frame, live"
            # While playing only now and then: they cost more than the frame.
            if self._show_maps.value != self._maps_folder.visible:
                self._maps_folder.visible = self._show_maps.value
            if self._show_maps.value and (not self._playing.value or frame % 10 == 0):
                self._draw_maps(self.shown, frame)

    def _draw_maps(self, shown: Shown, frame: int) -> None:
        worn = tuple(t for t in TEMPLATES if t in shown.choice.wear)
        pictures = shown.maps(frame, worn or TEMPLATES)
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
        while not self._over.is_set():
            shown = self.shown
            if shown is None or not self._playing.value or not self.server.get_clients():
                self._over.wait(0.1)
                due = time.monotonic()
                continue
            try:
                # Setting the slider shows the frame.
                self._frame.value = (int(self._frame.value) + 1) % shown.num_frames
            except Exception as error:
                # One frame that can't be shown doesn't end the clip.
                self._tell(error)
                self._playing.value = False
            due = max(due + 1.0 / shown.clip.fps, time.monotonic() - 1.0)
            self._over.wait(max(due - time.monotonic(), 0.0))
