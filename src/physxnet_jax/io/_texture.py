"""Images that materials name: found beside a mesh's file, written beside a clip."""

import pathlib
import re
from collections.abc import Iterable

from ..files import whole_file
from ..geometry import Texture, make_texture

_MAX_BYTES = 100_000_000
# What a name may have in it in every format and on every system.
_UNFIT = re.compile(r"[^A-Za-z0-9._-]")


def texture_beside(file: str | pathlib.Path, name: str) -> Texture:
    """The image that a file names, if it lies in that file's folder or below.

    Programs write where the image lay on their own disk: it is also looked for by its
    name alone, beside the file and in ``textures``.

    Args:
        file: The file that names it.
        name: What it says.
    """
    folder = pathlib.Path(file).parent.resolve()
    told = name.replace("\\", "/")
    last = told.rpartition("/")[2]
    for place in (told, last, f"textures/{last}"):
        try:
            image = (folder / place).resolve()
            found = image.is_relative_to(folder) and image.is_file()
            if found and image.stat().st_size <= _MAX_BYTES:
                return make_texture(name, image.read_bytes())
        # A name may be none that any system has.
        except (OSError, ValueError):
            continue
    return make_texture(name, None)


def write_textures(
    path: str | pathlib.Path, textures: Iterable[Texture | None]
) -> dict[Texture, pathlib.Path]:
    """Writes images beside a file, as ``STEM_NAME.png``, each whole or not at all.

    Args:
        path: The file.
        textures: Which; what has no data is left out.

    Returns:
        Where each is.
    """
    path = pathlib.Path(path)
    out: dict[Texture, pathlib.Path] = {}
    for t in textures:
        if t is None or t.data is None or t in out:
            continue
        # A name's own ending may lie.
        stem = f"{path.stem}_{pathlib.PurePosixPath(t.name).stem or 'image'}"
        stem, ending, count = _UNFIT.sub("_", stem), t.ending, 2
        place = path.with_name(f"{stem}{ending}")
        while place in out.values():
            place, count = path.with_name(f"{stem}_{count}{ending}"), count + 1
        with whole_file(place) as part:
            part.write_bytes(t.data)
        out[t] = place
    return out
