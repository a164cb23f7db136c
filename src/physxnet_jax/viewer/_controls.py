"""The controls of the page, and the settings that they stand for."""

import dataclasses
import pathlib
import re
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np

from ..body import load_body
from ..dressing import METHODS, Inference, is_character
from ..errors import FormatError, PhysXNetError
from ..garment import FABRICS, TEMPLATES, find_fabric
from ..io import EXTENSIONS, GARMENT_FORMATS, GltfFile
from ..models import list_weights
from ..motion import CLIPS
from ..simulation import PRESETS
from ._guard import MOST_UPLOADED
from ._job import Choice

METHOD_LABELS = {
    "guided": "guided simulation",
    "network": "network alone",
    "simulate": "full simulation",
    "lbs": "skinning",
}
"""Names of the methods on the page."""

_MOTIONS = (".bvh", ".amc", ".npz", ".pkl", ".glb", ".gltf", ".vrma")
_FIGURES = (".vrm", ".glb", ".gltf")
_AS_CUT, _BUILT_IN = "as cut", "the built-in body"
# All uploads of a session [bytes].
_MOST_KEPT = 5 * MOST_UPLOADED


class Controls:
    """Menus, boxes and sliders of a page.

    What they name is looked up among clips, garments and files that were named at the start or
    uploaded; nothing else is ever opened.

    Args:
        gui: viser's interface to the page's panel.
        choice: Initial settings.
        folder: Where uploads are kept.

    Attributes:
        files: Files by the names that the page shows.
        settings: Controls of settings by name.
        worn: A box for each garment.
        shapes: A slider for each shape parameter.
    """

    def __init__(self, gui: Any, choice: Choice, folder: pathlib.Path) -> None:
        assert set(METHOD_LABELS) == set(METHODS)
        self.files: dict[str, pathlib.Path] = {}
        self.settings: dict[str, Any] = {}
        self.worn: dict[str, Any] = {}
        self.shapes: dict[str, Any] = {}
        self._gui, self._initial, self._folder = gui, choice, folder
        self._uploads: dict[str, int] = {}
        self._received = 0
        self._skeleton: pathlib.Path | None = None
        self._changed: Callable[[], None] = lambda: None
        self.status = gui.add_markdown("loading …")
        self.pace = gui.add_markdown("", visible=False)
        self.playing = gui.add_checkbox("play", True)
        self.frame = gui.add_slider("frame", 0, max(choice.frames - 1, 1), 1, 0)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Clothes"):
            self._add_clothes(choice)
        with tabs.add_tab("Method"):
            self._add_method(choice)
        with tabs.add_tab("Body"):
            self._add_body(choice)
        with tabs.add_tab("Export"):
            self.format = gui.add_dropdown("format", tuple(EXTENSIONS), initial_value=".usdc")
            self.export = gui.add_button("export")
            self.show_maps = gui.add_checkbox("network maps", False)
            self.maps = gui.add_folder("Maps", visible=False)

    def on_change(self, changed: Callable[[], None]) -> None:
        """Calls a function after each change of a setting."""
        self._changed = changed
        for handle in (*self.settings.values(), *self.shapes.values()):
            handle.on_update(lambda _: self._changed())

    def choice(self) -> Choice:
        """The settings.

        Raises:
            PhysXNetError: A control holds a value that it doesn't offer.
        """
        w, first = self.settings, self._initial
        for name, handle in w.items():
            if hasattr(handle, "options") and handle.value not in handle.options:
                raise PhysXNetError(f"{name}: '{handle.value}' isn't in the menu.")
        body = load_body()
        defaults = dict(zip(body.shape_names, np.asarray(body.default_shape()), strict=True))
        shape = tuple(
            (name, float(handle.value))
            for name, handle in self.shapes.items()
            if abs(handle.value - defaults[name]) > 1e-6
        )
        motion = str(self.files.get(w["motion"].value, w["motion"].value))
        # Options of the first motion file don't apply to another one.
        known = motion == str(pathlib.Path(first.motion))
        skeleton = first.skeleton if known else None
        if skeleton is None and motion.endswith(".amc") and w["motion"].value in self._uploads:
            skeleton = self._skeleton
        fabric = w["fabric"].value
        height = first.simulation.wind[1] if first.simulation.wind else 0.0
        wind = (float(w["wind_x"].value), height, float(w["wind_z"].value))
        method = next(m for m, label in METHOD_LABELS.items() if label == w["method"].value)
        return dataclasses.replace(
            first,
            motion=motion,
            source_fps=first.source_fps if known else None,
            skeleton=skeleton,
            joint_map=first.joint_map if known else None,
            wear=self._wear(),
            method=method,
            inference=Inference(
                weights=w["weights"].value,
                tta=w["tta"].value,
                strain_iterations=self._iterations if w["strain"].value else 0,
                collisions=w["collisions"].value,
            ),
            compare=w["compare"].value,
            live=w["live"].value,
            shape=shape,
            fabric=None if fabric == _AS_CUT else str(self.files.get(fabric, fabric)),
            character=self.files.get(w["person"].value),
            simulation=dataclasses.replace(
                first.simulation,
                accuracy=w["accuracy"].value,
                wind=wind if any(wind) else None,
                self_contact=w["self_contact"].value,
            ),
            frames=int(w["frames"].value),
        )

    def add_file(self, name: str, content: bytes) -> None:
        """Adds an uploaded motion, garment, character or fabric, and chooses it.

        Raises:
            FormatError: The file is of another kind.
            PhysXNetError: Too much has been uploaded.
        """
        # Only the last part, in plain characters: an uploaded name must not act as a path.
        name = re.sub(r"[^\w.-]", "_", pathlib.PurePosixPath(name.replace("\\", "/")).name)[-80:]
        suffix = pathlib.Path(name).suffix.lower()
        known = (*_MOTIONS, *GARMENT_FORMATS, *_FIGURES, ".asf", ".toml")
        if suffix not in known or name.startswith("."):
            raise FormatError(
                f"{name}: neither a motion ({', '.join(_MOTIONS)}), a garment"
                f" ({', '.join(GARMENT_FORMATS)}), a character ({', '.join(_FIGURES)}) nor a"
                " fabric (.toml)."
            )
        kept = sum(self._uploads.values()) + len(content)
        if len(content) > MOST_UPLOADED or kept > _MOST_KEPT:
            raise PhysXNetError(
                f"{name}: {len(content) / 1e6:.0f} MB; a file may have {MOST_UPLOADED / 1e6:.0f} MB"
                f" and all of a session {_MOST_KEPT / 1e6:.0f} MB."
            )
        # Each in a folder of its own: a name that is used again must not touch another file.
        self._received += 1
        folder = self._folder / f"{self._received:04d}"
        folder.mkdir()
        path = folder / name
        path.write_bytes(content)
        try:
            kinds = () if suffix == ".asf" else _kinds(path)
        except Exception:
            shutil.rmtree(folder)
            raise
        label = name
        while label in (*self.files, *self._uploads, *CLIPS, *TEMPLATES, *FABRICS):
            stem, n = re.fullmatch(r"(.*?)(?: \((\d+)\))?", label, re.DOTALL).groups()  # pyright: ignore[reportOptionalMemberAccess]
            label = f"{stem} ({int(n or 1) + 1})"
        self._uploads[label] = len(content)
        if suffix == ".asf":
            # The AMC file that needs it may already be there.
            self._skeleton = path
            return
        self.files[label] = path
        if "garment" in kinds:
            with self._garments:
                self._add_garment(label, True)
        for name in ("motion", "person", "fabric"):
            if name in kinds:
                menu = self.settings[name]
                menu.options = (*menu.options, label)
                menu.value = label

    def _wear(self) -> tuple[str, ...]:
        """The ticked garments in command-line order: of one type, later ones are outer."""
        ticked = [str(self.files.get(n, n)) for n, box in self.worn.items() if box.value]
        return tuple(sorted(ticked, key=[*self._initial.wear, *ticked].index))

    def _add_clothes(self, choice: Choice) -> None:
        gui, w = self._gui, self.settings
        clips = tuple(CLIPS)
        first = choice.motion
        if first not in clips:
            first = pathlib.Path(choice.motion).name
            self.files[first] = pathlib.Path(choice.motion)
            clips = (*clips, first)
        w["motion"] = gui.add_dropdown("motion", clips, initial_value=first)
        w["frames"] = gui.add_slider("frames", 1, max(600, choice.frames), 1, choice.frames)
        self.upload = gui.add_upload_button("add a motion, garment, character or fabric")
        self._garments = gui.add_folder("Garments")
        with self._garments:
            for name in dict.fromkeys((*TEMPLATES, *choice.wear)):
                short = name
                if name not in TEMPLATES:
                    path = pathlib.Path(name)
                    # Files of the same name are distinguished by their paths.
                    short = name if path.name in self.files else path.name
                    self.files[short] = path
                self._add_garment(short, name in choice.wear)
        wind = choice.simulation.wind or (0.0, 0.0, 0.0)
        strongest = max(10.0, *map(abs, wind))
        wind_range = (-strongest, strongest, 0.5)
        fabrics, fabric = (_AS_CUT, *FABRICS), choice.fabric or _AS_CUT
        if fabric not in fabrics:
            fabric = self._named(pathlib.Path(fabric))
            fabrics = (*fabrics, fabric)
        w["fabric"] = gui.add_dropdown("fabric", fabrics, initial_value=fabric)
        w["wind_x"] = gui.add_slider("wind from the right, m/s", *wind_range, wind[0])
        w["wind_z"] = gui.add_slider("wind from behind, m/s", *wind_range, wind[2])

    def _add_method(self, choice: Choice) -> None:
        gui, w, simulation = self._gui, self.settings, choice.simulation
        w["method"] = gui.add_dropdown(
            "method",
            tuple(METHOD_LABELS.values()),
            initial_value=METHOD_LABELS[choice.method],
        )
        name, inference = str(choice.inference.weights), choice.inference
        self._iterations = inference.strain_iterations or Inference().strain_iterations
        w["weights"] = gui.add_dropdown(
            "network", tuple(dict.fromkeys((*list_weights(), name))), initial_value=name
        )
        w["live"] = gui.add_checkbox("compute while playing", choice.live)
        w["compare"] = gui.add_checkbox("compare with full simulation", choice.compare)
        with gui.add_folder("Network alone"):
            w["collisions"] = gui.add_checkbox("keep cloth off the skin", inference.collisions)
            w["strain"] = gui.add_checkbox("limit stretch", inference.strain_iterations > 0)
            w["tta"] = gui.add_checkbox("average with mirrored pose", inference.tta)
        with gui.add_folder("Full simulation"):
            w["accuracy"] = gui.add_dropdown(
                "accuracy", tuple(PRESETS), initial_value=simulation.accuracy
            )
            w["self_contact"] = gui.add_checkbox("cloth touches itself", simulation.self_contact)

    def _add_body(self, choice: Choice) -> None:
        people, person = (_BUILT_IN,), _BUILT_IN
        if choice.character is not None:
            person = self._named(choice.character)
            people = (_BUILT_IN, person)
        self.settings["person"] = self._gui.add_dropdown("person", people, initial_value=person)
        body, overrides = load_body(), dict(choice.shape)
        for name, x in zip(body.shape_names, np.asarray(body.default_shape()), strict=True):
            value = round(overrides.get(name, float(x)), 2)
            self.shapes[name] = self._gui.add_slider(
                name.replace("_", " "), min(0.0, value), max(1.0, value), 0.05, value
            )

    def _named(self, path: pathlib.Path) -> str:
        """A name for a file of the command, which no other file has."""
        name, n = path.name, 1
        while name in self.files:
            n += 1
            name = f"{path.name} ({n})"
        self.files[name] = path
        return name

    def _add_garment(self, name: str, worn: bool) -> None:
        box = self._gui.add_checkbox(name, worn)
        box.on_update(lambda _: self._changed())
        self.worn[name] = box


def _kinds(path: pathlib.Path) -> tuple[str, ...]:
    """What an uploaded file is: garment, motion, person, fabric, or a person with a motion.

    Raises:
        PhysXNetError: The file isn't what its name says.
    """
    suffix = path.suffix.lower()
    if suffix == ".toml":
        find_fabric(path)
        return ("fabric",)
    if suffix not in _FIGURES:
        return ("motion",) if suffix in _MOTIONS else ("garment",)
    moves = ("motion",) if GltfFile(path).document.animations else ()
    if is_character(path):
        return ("person", *moves)
    if suffix == ".vrm":
        raise FormatError(f"{path.name}: no person with a known skeleton.")
    # A glTF file without animations is a garment.
    return moves or ("garment",)
