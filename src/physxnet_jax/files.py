"""Atomic file writing, JSON logs and safe reading of untrusted archives."""

import contextlib
import errno
import functools
import inspect
import io
import json
import math
import os
import pathlib
import platform
import re
import shutil
import signal
import stat
import tempfile
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np

from .errors import BusyError, DiskFullError, FormatError

_P = ParamSpec("_P")
_T = TypeVar("_T")

# Where less is free, a writer that failed failed for that [bytes].
_FULL = 1_000_000
_HOST = f"{zlib.crc32(platform.node().encode()):08x}"
_PART = re.compile(r"\.part-([0-9a-f]{8})-(\d+)-")
# Files that the running command reads and their times of change [ns], by device and inode.
_inputs: dict[tuple[int, int], tuple[pathlib.Path, int]] = {}
_keeping = False
_swept: set[pathlib.Path] = set()
# Longest name of a file on most systems, and what names of unfinished parts add [bytes].
_LONGEST_NAME, _ADDED = 255, 60


@contextlib.contextmanager
def keep_inputs() -> Iterator[None]:
    """Within it, files of `add_inputs` aren't replaced by `atomic_write`."""
    global _keeping
    before, keeping, _keeping = dict(_inputs), _keeping, True
    try:
        yield
    finally:
        _keeping = keeping
        _inputs.clear()
        _inputs.update(before)


def add_inputs(*paths: str | pathlib.Path) -> None:
    """Notes files that a command reads; what doesn't exist is skipped.

    Readers call it for every file that they open. Outside `keep_inputs` it does nothing: a program
    may replace what it has read.
    """
    for path in paths if _keeping else ():
        with contextlib.suppress(OSError, ValueError):
            if os.path.isfile(path):
                found = os.stat(path)
                _inputs[found.st_dev, found.st_ino] = pathlib.Path(path), found.st_mtime_ns


def _names(path: pathlib.Path, found: os.stat_result) -> bool:
    with contextlib.suppress(OSError):
        return os.path.samestat(os.stat(path), found)
    return False


def check_replaceable(path: str | pathlib.Path) -> None:
    """Checks that writing a file destroys nothing that a person may want to keep.

    Raises:
        FormatError: It is an input of the running command, under whatever name, read-only, or no
            ordinary file.
    """
    try:
        found = os.stat(path)
    except OSError:
        return
    if not stat.S_ISREG(found.st_mode):
        raise FormatError(f"{path}: this isn't an ordinary file. Choose another output.")
    known, changed = _inputs.get((found.st_dev, found.st_ino), (None, 0))
    # A file that was deleted leaves its inode to another, which isn't an input.
    if known is not None and (found.st_mtime_ns == changed or _names(known, found)):
        same = "" if str(known) == str(path) else f", which is {known}"
        raise FormatError(f"{path}: this is an input{same}. Choose another output.")
    if not os.access(path, os.W_OK) or not found.st_mode & 0o222:
        raise FormatError(f"{path}: this file is read-only. Choose another output.")


@contextlib.contextmanager
def atomic_write(path: str | pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a temporary path that replaces ``path`` on success and is deleted on failure.

    A link is followed: what it points to is replaced. Temporary files that dead processes left
    in the folder are removed.

    Raises:
        FormatError: The file is read-only or an input, see `check_replaceable`.
        DiskFullError: The disk is full.

    Example:
        >>> import tempfile
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> with atomic_write(folder / "a.txt") as part:
        ...     _ = part.write_text("done")
        >>> [p.name for p in folder.iterdir()]
        ['a.txt']
    """
    path = pathlib.Path(path)
    path = _followed(path)
    check_replaceable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path.parent)
    # The name keeps the suffix because some writers choose the format by it. The ids let
    # processes and threads write the same file concurrently.
    ids = f"{_HOST}-{os.getpid()}-{threading.get_ident()}"
    part = path.with_name(f".part-{ids}-{path.name}")
    try:
        yield part
        part.replace(path)
    except Exception as error:
        # Libraries report a full disk in words of their own, or in none.
        free = shutil.disk_usage(path.parent).free
        if free < _FULL and not isinstance(error, DiskFullError):
            size = part.stat().st_size if part.exists() else 0
            raise DiskFullError(
                f"{path}: the disk is full. {size / 1e6:.1f} MB were written and"
                f" {free / 1e6:.1f} MB are free. Free some space or choose another disk."
            ) from error
        raise
    finally:
        part.unlink(missing_ok=True)


def _followed(path: pathlib.Path) -> pathlib.Path:
    """What a link points to."""
    if not path.is_symlink():
        return path
    try:
        return path.resolve()
    # Of a link that leads back to itself.
    except (OSError, RuntimeError):
        raise FormatError(f"{path}: a link that leads to itself. Choose another output.") from None


def _sweep(folder: pathlib.Path) -> None:
    """Removes temporary files of dead processes of this machine, once for each folder."""
    folder = folder.absolute()
    if folder in _swept or os.name == "nt":
        return
    _swept.add(folder)
    for left in folder.glob(".part-*"):
        match = _PART.match(left.name)
        if match is not None and match[1] == _HOST and not _is_alive(int(match[2])):
            with contextlib.suppress(OSError):
                left.unlink()


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        pass
    return True


@contextlib.contextmanager
def claim(path: str | pathlib.Path, *, wait: bool = False) -> Iterator[None]:
    """Within it, no other process can claim the same file or folder.

    The system releases the claim of a process that dies, however it does. Where a file system has
    no locks, nothing is claimed.

    Args:
        path: What is written to; it need not exist.
        wait: Wait for another owner to finish instead of raising.

    Raises:
        BusyError: Another process, or another thread, has it.
    """
    path = pathlib.Path(path).absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    while True:
        file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _lock(file, wait)
            # Its last owner may have removed it meanwhile: then it locks nothing.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file), os.stat(lock)):
                    break
        except (BlockingIOError, PermissionError):
            # Whoever has it may have written nothing yet.
            owner = os.read(file, 200).decode(errors="replace").strip() or "another process"
            os.close(file)
            raise BusyError(
                f"{path}: in use by {owner}. Wait until it has finished, or choose another folder."
            ) from None
        except OSError:
            os.close(file)
            raise
        os.close(file)
    try:
        os.truncate(file, 0)
        os.write(file, f"process {os.getpid()} on {platform.node()}".encode())
        yield
    finally:
        with contextlib.suppress(OSError):
            lock.unlink()
        os.close(file)


def claims(
    argument: str, *, unless: Callable[[], object] = lambda: False
) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Decorates a function that claims what an argument names, unless that is None.

    Args:
        argument: Name of the argument.
        unless: Called each time; if true, nothing is claimed.
    """

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def claiming(*args: _P.args, **kwargs: _P.kwargs) -> _T:
            path = signature.bind(*args, **kwargs).arguments.get(argument)
            with contextlib.nullcontext() if path is None or unless() else claim(path):
                return function(*args, **kwargs)

        return claiming

    return decorate


def _lock(file: int, wait: bool) -> None:
    if os.name == "nt":
        import msvcrt

        msvcrt.locking(file, msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)  # pyright: ignore
    else:
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                raise


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Within it Ctrl-C and SIGTERM wait; they act at its end, unless an error ends it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    # Another language's handler can't be put back.
    known = {s: handler for s, handler in before.items() if handler is not None}
    for s in known:
        signal.signal(s, lambda number, _: caught.append(number))
    try:
        yield
    finally:
        for s, handler in known.items():
            signal.signal(s, handler)
    for number in caught[:1]:
        signal.raise_signal(number)


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


def check_writable(path: str | pathlib.Path, size: int = 0) -> None:
    """Checks that a file can be written, without creating it.

    Args:
        path: The file.
        size: What it will have at least [bytes], if known.

    Raises:
        FormatError: The path is a folder, an input or read-only, or nothing can be written there.
        DiskFullError: Less is free than it needs.
    """
    path = pathlib.Path(path)
    path = _followed(path)
    if path.is_dir():
        raise FormatError(f"{path}: this is a folder. Name a file in it.")
    if len(os.fsencode(path.name)) > _LONGEST_NAME - _ADDED:
        raise FormatError(
            f"{path.name[:40]}…: the name is too long. Choose one of at most"
            f" {_LONGEST_NAME - _ADDED} bytes."
        )
    check_replaceable(path)
    existing = next((p for p in path.absolute().parents if p.exists()), pathlib.Path("/"))
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
        free = shutil.disk_usage(existing).free
    except OSError as error:
        raise FormatError(
            f"{path}: nothing can be written there ({error.strerror}). Choose another folder."
        ) from None
    if free < size:
        raise DiskFullError(
            f"{path}: about {size / 1e6:.0f} MB are needed, but {free / 1e6:.0f} MB are free."
            " Free some space, choose another disk or fewer --frames."
        )


def read_arrays(
    path: str | pathlib.Path | bytes,
    names: Sequence[str] | None = None,
    *,
    limit: int | None = None,
) -> dict[str, np.ndarray]:
    """Reads arrays of an `.npz` by name; skips names that aren't in it.

    Nothing is unpickled. The size in an array's header is compared with the size in the
    archive before memory is allocated.

    Args:
        path: The archive, or its content.
        names: Arrays to read; all if omitted.
        limit: Maximum total size of the arrays, uncompressed [bytes]; by default 25 times the
            archive's size, but at least 150 MB and at most 2 GB.

    Raises:
        ValueError: The file isn't an `.npz` archive, an array holds Python objects, a
            header contradicts the data, or the limit is exceeded.
        OSError: The file can't be opened.
    """
    out: dict[str, np.ndarray] = {}
    total = 0
    # Once the file opens, any later OSError means invalid offsets in the archive.
    if isinstance(path, bytes):
        size = len(path)
    else:
        with pathlib.Path(path).open("rb") as opened:
            size = opened.seek(0, os.SEEK_END)
    if limit is None:
        limit = min(2_000_000_000, max(150_000_000, 25 * size))
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
                    raise ValueError(
                        f"over {limit / 1e6:.0f} MB of data in an archive of {size / 1e6:.1f} MB"
                    )
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
