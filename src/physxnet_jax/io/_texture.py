"""Texture images of materials: found beside a mesh's file, written beside a clip."""

import pathlib
import re
from collections.abc import Iterable

from ..files import add_inputs, atomic_write
from ..geometry import Texture, make_texture

_MAX_BYTES = 100_000_000
# Characters that file names may not contain in some format or on some system.
_INVALID = re.compile(r"[^A-Za-z0-9._-]")


def texture_beside(file: str | pathlib.Path, name: str) -> Texture:
    """Finds the image that a file refers to, if it is in that file's folder or below.

    Programs write paths of their own disk, so the base name alone is also searched for
    beside the file and in ``textures``.

    Args:
        file: The file that refers to the image.
        name: The reference.
    """
    folder = pathlib.Path(file).parent.resolve()
    relative = name.replace("\\", "/")
    base_name = relative.rpartition("/")[2]
    for place in (relative, base_name, f"textures/{base_name}"):
        try:
            image = (folder / place).resolve()
            found = image.is_relative_to(folder) and image.is_file()
            if found and image.stat().st_size <= _MAX_BYTES:
                add_inputs(image)
                return make_texture(name, image.read_bytes())
        # The reference may be no valid path.
        except (OSError, ValueError):
            continue
    return make_texture(name, None)


def write_textures(
    path: str | pathlib.Path, textures: Iterable[Texture | None]
) -> dict[Texture, pathlib.Path]:
    """Writes images beside a file, as ``STEM_NAME.png``, each atomically.

    Args:
        path: The file.
        textures: Textures to write; those without data are skipped.

    Returns:
        The path of each image.
    """
    path = pathlib.Path(path)
    out: dict[Texture, pathlib.Path] = {}
    for t in textures:
        if t is None or t.data is None or t in out:
            continue
        # The extension in a name may be wrong.
        stem = f"{path.stem}_{pathlib.PurePosixPath(t.name).stem or 'image'}"
        stem, ending, count = _INVALID.sub("_", stem), t.ending, 2
        place = path.with_name(f"{stem}{ending}")
        while place in out.values():
            place, count = path.with_name(f"{stem}_{count}{ending}"), count + 1
        with atomic_write(place) as part:
            part.write_bytes(t.data)
        out[t] = place
    return out
