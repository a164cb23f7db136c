"""Checkpoints through orbax: the whole state, resumed exactly."""

import dataclasses
import json
import pathlib
from typing import Any

import jax
import orbax.checkpoint as ocp

from ..errors import PhysXNetError
from ._step import TrainState


class Checkpoints:
    """The checkpoints of one run.

    Args:
        folder: Where they lie; made if absent.
        keep: How many of the newest are kept.
    """

    def __init__(self, folder: str | pathlib.Path, *, keep: int = 2) -> None:
        self._manager = ocp.CheckpointManager(
            pathlib.Path(folder).absolute(),
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep, create=True, enable_async_checkpointing=False
            ),
        )

    def save(self, state: TrainState, info: dict[str, Any]) -> None:
        """Saves a state under its step number; whole or not at all.

        Raises:
            PhysXNetError: A later state lies there.
        """
        if self._manager.latest_step() == int(state.step):
            return
        saved = self._manager.save(
            int(state.step),
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(_plain(state)), info=ocp.args.JsonSave(info)
            ),
        )
        self._manager.wait_until_finished()
        if not saved:
            raise PhysXNetError(
                f"{self._manager.directory}: step {int(state.step)} wasn't saved, step"
                f" {self._manager.latest_step()} lies there. Delete it, or choose another folder."
            )

    def forget_after(self, step: int) -> None:
        """Removes states of later steps: a run that was killed will do those again."""
        for later in self._manager.all_steps():
            if later > step:
                self._manager.delete(later)

    def latest(self, like: TrainState) -> TrainState | None:
        """The newest state, shaped as ``like``; None if there is none.

        Raises:
            PhysXNetError: A damaged one.
        """
        step = self._manager.latest_step()
        if step is None:
            return None
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, _plain(like))
        wanted = ocp.args.Composite(state=ocp.args.StandardRestore(abstract))
        try:
            got = self._manager.restore(step, args=wanted)
        # Files are read by several libraries, each with errors of its own.
        except Exception as error:
            raise PhysXNetError(
                f"{self._manager.directory}/{step}: the state there is damaged"
                f" ({type(error).__name__}). Delete that folder: the run goes on from the one"
                " before."
            ) from error
        return jax.tree.unflatten(jax.tree.structure(like), got["state"])

    def close(self) -> None:
        """Waits for what is being written."""
        self._manager.close()


def _plain(state: TrainState) -> list[Any]:
    """The leaves in order: their structure comes from the config, not from the disk."""
    return jax.tree.leaves(state)


def config_json(config: Any, data: str) -> str:
    """A run as JSON: its frozen config and what it learns from."""
    return json.dumps({**dataclasses.asdict(config), "data": data}, indent=1, sort_keys=True)
