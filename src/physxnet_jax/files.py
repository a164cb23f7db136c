"""Writing files whole or not at all, reading archives of unknown origin."""

import contextlib
import json
import math
import os
import pathlib
import tempfile
import threading
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from .errors import FormatError


@contextlib.contextmanager
def whole_file(path: str | pathlib.Path) -> Iterator[pathlib.Path]:
    """A path to write to that becomes ``path`` on success and vanishes on failure.

    Example:
        >>> import tempfile
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> with whole_file(folder / "a.txt") as part:
        ...     _ = part.write_text("done")
        >>> [p.name for p in folder.iterdir()]
        ['a.txt']
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays: some writers choose their format by it. Processes and threads may
    # write side by side what is the same.
    part = path.with_name(f".part-{os.getpid()}-{threading.get_ident()}-{path.name}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def json_text(values: object) -> str:
    """JSON of nested values; paths are text, and what isn't finite is null: JSON has no NaN.

    Example:
        >>> print(json_text({"file": pathlib.PurePosixPath("a.obj"), "gap": math.inf}))
        {
         "file": "a.obj",
         "gap": null
        }
    """
    return json.dumps(_plain(values), indent=1, allow_nan=False)


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, pathlib.PurePath) else value


def write_json(path: str | pathlib.Path, values: object) -> None:
    """Writes `json_text` of nested values, whole or not at all."""
    with whole_file(path) as part:
        part.write_text(json_text(values) + "\n", encoding="utf-8")


def append_line(path: str | pathlib.Path, values: Mapping[str, Any]) -> None:
    """Adds a line of JSON to a log; one that a kill cut short before it stays alone."""
    with pathlib.Path(path).open("a+b") as log:
        if log.tell():
            log.seek(-1, os.SEEK_END)
            if log.read(1) != b"\n":
                log.write(b"\n")
        log.write(json.dumps(values).encode() + b"\n")


def read_lines(path: str | pathlib.Path) -> list[dict[str, Any]]:
    """A log of `append_line`: none if there is no file; a line that was cut is left out."""
    path = pathlib.Path(path)
    if not path.is_file():
        return []
    out = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        with contextlib.suppress(ValueError, RecursionError):
            out.append(json.loads(line))
    return [values for values in out if isinstance(values, dict)]


def is_file(path: str | pathlib.Path) -> bool:
    """Whether there is such a file: none of a name that the system can't have."""
    return os.path.isfile(path)


def check_writable(path: str | pathlib.Path) -> None:
    """Fails where a file couldn't be written; makes nothing.

    Raises:
        FormatError: A folder of that name, or a place where nothing can be made.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        raise FormatError(f"{path}: a folder. Name a file in it.")
    there = next((p for p in path.absolute().parents if p.exists()), pathlib.Path("/"))
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise FormatError(
            f"{path}: nothing can be written there ({error.strerror}). Choose another folder."
        ) from None


def read_arrays(
    path: str | pathlib.Path, names: Sequence[str] | None = None, *, limit: int = 2_000_000_000
) -> dict[str, np.ndarray]:
    """Arrays of an `.npz`, by name; those that aren't in it are left out.

    Nothing is unpickled. What an array's header announces is compared with what the
    archive holds before memory is asked for.

    Args:
        path: The archive.
        names: Which arrays to read; all if omitted.
        limit: Largest size of all of them together, unpacked [bytes].

    Raises:
        ValueError: Not such an archive, an array of objects, a header that lies, or
            too much data.
        OSError: The file can't be opened.
    """
    out: dict[str, np.ndarray] = {}
    total = 0
    # From here on an error of the system means an archive that points nowhere.
    with pathlib.Path(path).open("rb"):
        pass
    try:
        with zipfile.ZipFile(path) as archive:
            held = {i.filename.removesuffix(".npy"): i for i in archive.infolist()}
            for name in held if names is None else names:
                if name not in held:
                    continue
                info = held[name]
                total += info.file_size
                if total > limit:
                    raise ValueError(f"over {limit / 1e9:.1f} GB of data")
                with archive.open(info) as member:
                    _check_header(member, name, info.file_size)
                with archive.open(info) as member:
                    out[name] = np.lib.format.read_array(member, allow_pickle=False)
    except ValueError:
        raise
    # NumPy parses a header as Python; what is in it may break in any way.
    except Exception as error:
        raise ValueError(f"not an archive of arrays ({error})") from error
    return out


def _check_header(member: Any, name: str, size: int) -> None:
    version = np.lib.format.read_magic(member)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise ValueError(f"'{name}' is of format {version}")
    shape, _, dtype = readers[version](member)
    if dtype.hasobject:
        raise ValueError(f"'{name}' holds Python objects, which are never loaded")
    wanted = math.prod(shape) * dtype.itemsize
    if wanted != size - member.tell():
        raise ValueError(f"'{name}' announces {wanted:,} bytes and has {size - member.tell():,}")
