"""Atomic file writing, JSON logs and safe reading of untrusted archives."""

import contextlib
import io
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
def atomic_write(path: str | pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a temporary path that replaces ``path`` on success and is deleted on failure.

    Example:
        >>> import tempfile
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> with atomic_write(folder / "a.txt") as part:
        ...     _ = part.write_text("done")
        >>> [p.name for p in folder.iterdir()]
        ['a.txt']
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The name keeps the suffix because some writers choose the format by it. The ids let
    # processes and threads write the same file concurrently.
    part = path.with_name(f".part-{os.getpid()}-{threading.get_ident()}-{path.name}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def json_text(values: object) -> str:
    """Nested values as JSON; paths become strings, non-finite numbers null (JSON has no NaN).

    Example:
        >>> print(json_text({"file": pathlib.PurePosixPath("a.obj"), "gap": math.inf}))
        {
         "file": "a.obj",
         "gap": null
        }
    """
    return json.dumps(_to_jsonable(values), indent=1, allow_nan=False)


def _to_jsonable(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(k): _to_jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_to_jsonable(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, pathlib.PurePath) else value


def write_json(path: str | pathlib.Path, values: object) -> None:
    """Writes `json_text` of nested values atomically."""
    with atomic_write(path) as part:
        part.write_text(json_text(values) + "\n", encoding="utf-8")


def append_line(path: str | pathlib.Path, values: Mapping[str, Any]) -> None:
    """Appends a line of JSON to a log, after ending a previous line that was cut short."""
    with pathlib.Path(path).open("a+b") as log:
        if log.tell():
            log.seek(-1, os.SEEK_END)
            if log.read(1) != b"\n":
                log.write(b"\n")
        log.write(json.dumps(values).encode() + b"\n")


def read_lines(path: str | pathlib.Path) -> list[dict[str, Any]]:
    """Reads a log of `append_line`; a missing file is empty, truncated lines are skipped."""
    path = pathlib.Path(path)
    if not path.is_file():
        return []
    out = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        with contextlib.suppress(ValueError, RecursionError):
            out.append(json.loads(line))
    return [values for values in out if isinstance(values, dict)]


def is_file(path: str | pathlib.Path) -> bool:
    """Whether a file exists; False for names that the system doesn't allow."""
    return os.path.isfile(path)


def check_writable(path: str | pathlib.Path) -> None:
    """Checks that a file can be written, without creating it.

    Raises:
        FormatError: The path is a folder, or nothing can be written there.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        raise FormatError(f"{path}: this is a folder. Name a file in it.")
    existing = next((p for p in path.absolute().parents if p.exists()), pathlib.Path("/"))
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise FormatError(
            f"{path}: nothing can be written there ({error.strerror}). Choose another folder."
        ) from None


def read_arrays(
    path: str | pathlib.Path | bytes,
    names: Sequence[str] | None = None,
    *,
    limit: int = 2_000_000_000,
) -> dict[str, np.ndarray]:
    """Reads arrays of an `.npz` by name; skips names that aren't in it.

    Nothing is unpickled. The size in an array's header is compared with the size in the
    archive before memory is allocated.

    Args:
        path: The archive, or its content.
        names: Arrays to read; all if omitted.
        limit: Maximum total size of the arrays, uncompressed [bytes].

    Raises:
        ValueError: The file isn't an `.npz` archive, an array holds Python objects, a
            header contradicts the data, or the limit is exceeded.
        OSError: The file can't be opened.
    """
    out: dict[str, np.ndarray] = {}
    total = 0
    # Once the file opens, any later OSError means invalid offsets in the archive.
    if not isinstance(path, bytes):
        with pathlib.Path(path).open("rb"):
            pass
    try:
        file = io.BytesIO(path) if isinstance(path, bytes) else path
        with zipfile.ZipFile(file) as archive:
            members = {i.filename.removesuffix(".npy"): i for i in archive.infolist()}
            for name in members if names is None else names:
                if name not in members:
                    continue
                info = members[name]
                total += info.file_size
                if total > limit:
                    raise ValueError(f"over {limit / 1e9:.1f} GB of data")
                with archive.open(info) as member:
                    _check_header(member, name, info.file_size)
                with archive.open(info) as member:
                    out[name] = np.lib.format.read_array(member, allow_pickle=False)
    except ValueError:
        raise
    # NumPy parses headers as Python literals: a broken one may raise any exception.
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
        raise ValueError(f"'{name}' has the unsupported format version {version}")
    shape, _, dtype = readers[version](member)
    if dtype.hasobject:
        raise ValueError(f"'{name}' holds Python objects, which are never loaded")
    wanted = math.prod(shape) * dtype.itemsize
    if wanted != size - member.tell():
        raise ValueError(f"'{name}' announces {wanted:,} bytes and has {size - member.tell():,}")
