"""A glTF file's document: read if it is one, refused if it can't be used."""

import json
import pathlib
import struct
import warnings
from typing import Any

from ..errors import MissingDependencyError, MotionError
from ..files import is_file

MAX_BYTES = 1_000_000_000
"""Size of a file that is read at most."""

# Extensions that hide numbers.
_PACKED = ("EXT_meshopt_compression", "KHR_draco_mesh_compression")


def parse_gltf(path: pathlib.Path) -> Any:
    """The document, as pygltflib reads it, if it is glTF 2.0 that can be read.

    Raises:
        MotionError: Not glTF 2.0, too large, or compressed.
        MissingDependencyError: Without pygltflib.
    """
    try:
        import pygltflib
    except ImportError as error:
        raise MissingDependencyError(
            "Reading glTF needs pygltflib: pip install 'physxnet-jax[gltf]'."
        ) from error
    if not is_file(path):
        raise MotionError.at(path, None, "no such file", "Check the path")
    if path.stat().st_size > MAX_BYTES:
        raise MotionError.at(path, None, "over 1 GB", "Cut the clip into shorter files")
    binary = path.read_bytes()[:4] == b"glTF"
    try:
        loader = pygltflib.GLTF2()
        # It warns of what is refused below.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            document: Any = (loader.load_binary if binary else loader.load_json)(str(path))
        version = str(document.asset.version)
        # pygltflib leaves them out.
        for node, told in zip(document.nodes, _told_nodes(path, binary), strict=True):
            node.weights = told.get("weights")
    # The library fails in as many ways as a file can be broken.
    except Exception as error:
        raise MotionError.at(
            path,
            None,
            f"not a glTF file ({type(error).__name__}: {error})"[:300],
            "Export it again",
        ) from error
    if document is None or not version.startswith("2"):
        raise MotionError.at(path, None, f"glTF {version}", "Export it as glTF 2.0")
    for packed in _PACKED:
        if packed in (document.extensionsRequired or ()):
            raise MotionError.at(
                path,
                None,
                f"its numbers are compressed ({packed}), which isn't read",
                "Unpack it: npx @gltf-transform/cli copy IN OUT",
            )
    return document


def _told_nodes(path: pathlib.Path, binary: bool) -> list[dict[str, Any]]:
    """The nodes as the file has them."""
    with path.open("rb") as file:
        if binary:
            # A header of twelve bytes, then the size and the kind of the first chunk.
            size, _ = struct.unpack("<2I", file.read(20)[12:])
            text = file.read(size)
        else:
            text = file.read()
    return json.loads(text.decode("utf-8")).get("nodes") or []
