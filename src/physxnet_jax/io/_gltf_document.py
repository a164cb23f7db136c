"""Parses glTF documents and rejects those that can't be used."""

import json
import pathlib
import struct
import warnings
from typing import Any

from ..errors import MissingDependencyError, MotionError
from ..files import add_inputs, is_file

MAX_BYTES = 1_000_000_000
"""Largest file that is read [bytes]."""


def parse_gltf(path: pathlib.Path) -> Any:
    """Parses a glTF 2.0 file with pygltflib.

    Raises:
        MotionError: The file isn't glTF 2.0, or is too large.
        MissingDependencyError: pygltflib isn't installed.
    """
    try:
        import pygltflib
    except ImportError as error:
        raise MissingDependencyError(
            "Reading glTF needs pygltflib: pip install 'physxnet-jax[gltf]'."
        ) from error
    if not is_file(path):
        raise MotionError.at(path, None, "no such file", "Check the path")
    add_inputs(path)
    if path.stat().st_size > MAX_BYTES:
        raise MotionError.at(path, None, "over 1 GB", "Cut the clip into shorter files")
    binary = path.read_bytes()[:4] == b"glTF"
    try:
        loader = pygltflib.GLTF2()
        # It warns about files that are rejected below.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            document: Any = (loader.load_binary if binary else loader.load_json)(str(path))
        version = str(document.asset.version)
        # pygltflib drops the morph weights of nodes.
        for node, declared in zip(
            document.nodes, declared_tree(path).get("nodes") or [], strict=True
        ):
            node.weights = declared.get("weights")
    # pygltflib raises many exception types for damaged files.
    except Exception as error:
        raise MotionError.at(
            path,
            None,
            f"not a glTF file ({type(error).__name__}: {error})"[:300],
            "Export it again",
        ) from error
    if document is None or not version.startswith("2"):
        raise MotionError.at(path, None, f"glTF {version}", "Export it as glTF 2.0")
    return document


def declared_tree(path: pathlib.Path) -> dict[str, Any]:
    """The file's JSON as dictionaries."""
    with path.open("rb") as file:
        if file.read(4) == b"glTF":
            # A header of 12 bytes, then the length and type of the first chunk.
            size, _ = struct.unpack("<2I", file.read(16)[8:])
            text = file.read(size)
        else:
            file.seek(0)
            text = file.read()
    return json.loads(text.decode("utf-8"))
