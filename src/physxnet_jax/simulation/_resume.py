"""Storage of unfinished clips, so that they can be resumed."""

import contextlib
import hashlib
import itertools
import pathlib
import re
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import jax
import numpy as np

from .._version import __version__
from ..errors import SimulationError
from ..files import atomic_write, read_arrays

_State = TypeVar("_State")


QUICK = "quick "
"""Start of the keys of clips that take minutes, not hours."""


class Resume:
    """A folder with the finished blocks of frames of a clip.

    Each block is one file, written atomically, with the cloth's state at its end. The
    folder belongs to one scene, motion and solver; others are rejected.

    Args:
        folder: Folder of the blocks; created if needed, removed by `finish`.
        key: Identifies the clip, see `fingerprint`. Blocks of another clip whose key starts with
            `QUICK` are removed.

    Raises:
        SimulationError: The folder contains another clip or other files.
    """

    def __init__(self, folder: str | pathlib.Path, key: str) -> None:
        self.folder = pathlib.Path(folder)
        label = self.folder / "key.txt"
        if label.is_file() and label.read_text() != key:
            if not label.read_text().startswith(QUICK):
                raise SimulationError(
                    f"{self.folder} contains an unfinished rollout of another scene, motion or"
                    " setting. Finish that rollout, or remove the folder."
                )
            self.finish()
        if not label.is_file() and self.folder.is_dir() and any(self.folder.iterdir()):
            raise SimulationError(
                f"{self.folder} contains files that don't belong to a rollout. Choose an empty or"
                " a new folder."
            )
        with atomic_write(label) as part:
            part.write_text(key)

    def blocks(self, state: _State) -> Iterator[tuple[_State, dict[str, np.ndarray]]]:
        """Yields the state at the end of each block and the block's arrays, in order.

        Args:
            state: A state of the same structure.

        Raises:
            SimulationError: A block is damaged.
        """
        leaves, tree = jax.tree.flatten(state)
        for index in itertools.count():
            path = self._path(index)
            if not path.is_file():
                return
            try:
                data = read_arrays(path, limit=2 * path.stat().st_size + 1_000_000)
                arrays = {k[6:]: x for k, x in data.items() if k.startswith("array_")}
                found = [jax.device_put(data[f"state_{i}"]) for i in range(len(leaves))]
            except (ValueError, KeyError, OSError) as error:
                raise SimulationError(
                    f"{path}: damaged ({type(error).__name__}). Delete it and the blocks after it;"
                    " the rollout then resumes from the block before."
                ) from None
            yield jax.tree.unflatten(tree, found), arrays

    def save(self, index: int, state: Any, arrays: Mapping[str, np.ndarray]) -> None:
        """Writes one block."""
        entries = {f"state_{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(state))}
        entries |= {f"array_{k}": v for k, v in arrays.items()}
        with atomic_write(self._path(index)) as part, part.open("wb") as file:
            np.savez(file, allow_pickle=False, **entries)  # pyright: ignore[reportArgumentType]

    def finish(self) -> None:
        """Removes all blocks, and the folder if it is then empty."""
        # The key goes last: blocks without a key would be rejected.
        for file in (*self.folder.glob("block_*.npz"), self.folder / "key.txt"):
            file.unlink()
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def _path(self, index: int) -> pathlib.Path:
        return self.folder / f"block_{index:05d}.npz"


def fingerprint(*trees: Any) -> str:
    """A hash of pytrees (arrays and static fields) and of the package's and JAX's versions.

    It is the same in every process, so that another process can resume a rollout.
    """
    digest = hashlib.sha256()
    digest.update(f"{__version__} {jax.__version__}".encode())
    for tree in trees:
        leaves, structure = jax.tree.flatten(tree)
        # Functions among static fields are named with their addresses.
        digest.update(re.sub(r" at 0x[0-9a-fA-F]+", "", str(structure)).encode())
        for x in leaves:
            numbers = np.asarray(x)
            if numbers.dtype == object:
                # The bytes of an object array are addresses.
                digest.update(repr(x).encode())
            else:
                digest.update(f"{numbers.dtype} {numbers.shape}".encode())
                digest.update(np.ascontiguousarray(numbers).tobytes())
    return digest.hexdigest()
