"""Rollouts that go on where they were stopped."""

import contextlib
import hashlib
import pathlib
import zipfile
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._version import __version__
from ..errors import SimulationError
from ..files import whole_file


class Resume:
    """A folder that holds the blocks of a rollout that are done.

    Each block is one file, written whole or not at all, with the cloth's state at its
    end; the folder belongs to one scene, motion and solver, and refuses others.

    Args:
        folder: Where blocks are kept; made if needed, removed by `finish`.
        key: What the rollout is, see `fingerprint`.

    Raises:
        SimulationError: The folder holds another rollout, or something else.
    """

    def __init__(self, folder: str | pathlib.Path, key: str) -> None:
        self.folder = pathlib.Path(folder)
        label = self.folder / "key.txt"
        if label.is_file() and label.read_text() != key:
            raise SimulationError(
                f"{self.folder} holds an unfinished rollout of another scene, motion or"
                " setting. Finish that one, or remove the folder."
            )
        if not label.is_file() and self.folder.is_dir() and any(self.folder.iterdir()):
            raise SimulationError(
                f"{self.folder} holds files that are no rollout's. Name an empty folder, or none"
                " that is there."
            )
        with whole_file(label) as part:
            part.write_text(key)

    def load(self, state: Any) -> tuple[Any, list[np.ndarray], list[dict[str, np.ndarray]]]:
        """The last state (of the given structure), positions and diagnostics of blocks.

        Raises:
            SimulationError: A damaged block.
        """
        positions, diagnostics = [], []
        leaves, tree = jax.tree.flatten(state)
        while (path := self._path(len(positions))).is_file():
            try:
                with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                    moved = data["positions"]
                    info = {k[5:]: data[k] for k in data.files if k.startswith("info_")}
                    leaves = [jnp.asarray(data[f"state_{i}"]) for i in range(len(leaves))]
            except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
                raise SimulationError(
                    f"{path}: damaged ({type(error).__name__}). Delete it and those after it: the"
                    " rollout goes on from the block before."
                ) from None
            positions.append(moved)
            diagnostics.append(info)
        return jax.tree.unflatten(tree, leaves), positions, diagnostics

    def save(
        self, index: int, state: Any, positions: np.ndarray, diagnostics: dict[str, np.ndarray]
    ) -> None:
        """Keeps one block."""
        arrays = {f"state_{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(state))}
        arrays |= {f"info_{k}": v for k, v in diagnostics.items()}
        with whole_file(self._path(index)) as part, part.open("wb") as file:
            np.savez(file, allow_pickle=False, positions=positions, **arrays)

    def finish(self) -> None:
        """Removes what was kept, and the folder if nothing else is in it."""
        # The key last: without it what is left would be refused.
        for file in (*self.folder.glob("block_*.npz"), self.folder / "key.txt"):
            file.unlink()
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def _path(self, index: int) -> pathlib.Path:
        return self.folder / f"block_{index:05d}.npz"


def fingerprint(*trees: Any) -> str:
    """A hash of pytrees: their arrays and all that is static in them, and what computes them.

    The same in every process: a rollout goes on in another one.
    """
    digest = hashlib.sha256()
    digest.update(f"{__version__} {jax.__version__}".encode())
    for tree in trees:
        leaves, structure = jax.tree.flatten(tree)
        digest.update(str(structure).encode())
        for x in leaves:
            numbers = np.asarray(x)
            if numbers.dtype == object:
                # Its bytes would be an address.
                digest.update(repr(x).encode())
            else:
                digest.update(f"{numbers.dtype} {numbers.shape}".encode())
                digest.update(np.ascontiguousarray(numbers).tobytes())
    return digest.hexdigest()
