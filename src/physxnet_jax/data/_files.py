"""Files below a path or any URL that tensorstore takes; each is written whole or not at all."""

import functools
import pathlib

import tensorstore as ts

from ..errors import FormatError

# One context, so that every part of a program sees the same memory:// store.
_CONTEXT = ts.Context()


def join(where: str | pathlib.Path, *names: str) -> str:
    """A folder or file below a path or URL.

    Example:
        >>> join("s3://bucket/set/", "run", "top"), join("file:///a/|ocdbt:", "run")
        ('s3://bucket/set/run/top', 'file:///a/|ocdbt:run')
    """
    out = str(where)
    for name in names:
        out = out + name if out.endswith(("/", ":")) else f"{out}/{name}"
    return out


def last_name(where: str | pathlib.Path) -> str:
    """The last part of a path or URL."""
    return str(where).rstrip("/").replace(":", "/").rpartition("/")[2]


def read_file(where: str | pathlib.Path, name: str) -> bytes | None:
    """The content of a file, or None if there is none."""
    found = _opened(str(where)).read(name).result()
    return bytes(found.value) if found.state == "value" else None


def write_file(where: str | pathlib.Path, name: str, content: bytes) -> None:
    """Writes a file atomically.

    Raises:
        FormatError: Nothing can be written there.
    """
    try:
        _opened(str(where)).write(name, content).result()
    except (ValueError, OSError) as error:
        raise FormatError(f"{join(where, name)} can't be written: {error}") from error


def remove_file(where: str | pathlib.Path, name: str) -> None:
    """Removes a file, if there is one."""
    _opened(str(where)).delete_range(ts.KvStore.KeyRange(name, f"{name}\0")).result()


def list_files(where: str | pathlib.Path) -> list[str]:
    """Files below a folder, sorted by their parts; nothing that begins with a dot."""
    names = [key.decode() for key in _opened(str(where)).list().result()]
    # The locks of files that are being written end so.
    parts = [n.split("/") for n in names if not n.endswith(".__lock")]
    return ["/".join(p) for p in sorted(parts) if not any(x.startswith(".") for x in p)]


def open_array(where: str | pathlib.Path) -> ts.Future:
    """Opens a zarr array for reading."""
    spec = {"driver": "zarr3", "kvstore": _spec(str(where))}
    return ts.open(spec, read=True, context=_CONTEXT)


def _spec(where: str) -> str | dict[str, str]:
    if "://" not in where:
        return {"driver": "file", "path": f"{pathlib.Path(where).absolute()}/"}
    return where if where.endswith(("/", ":")) else f"{where}/"


@functools.lru_cache(maxsize=1024)
def _opened(where: str) -> ts.KvStore:
    try:
        return ts.KvStore.open(_spec(where), context=_CONTEXT).result()
    except ValueError as error:
        raise FormatError(f"{where} can't be opened: {error}") from error
