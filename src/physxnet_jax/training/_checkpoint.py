"""Checkpoints through orbax: the whole state is saved, so that runs resume exactly."""

import dataclasses
import json
import pathlib
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import orbax.checkpoint as ocp

from ..errors import PhysXNetError
from ..files import uninterrupted


@runtime_checkable
class Stepped(Protocol):
    """A pytree that counts its steps, such as `TrainState`."""

    @property
    def step(self) -> Any:
        """Steps done."""


State = TypeVar("State", bound=Stepped)


class Checkpoints:
    """The checkpoints of one run.

    Args:
        folder: Their folder; created if absent.
        keep: Number of newest checkpoints to keep.
    """

    def __init__(self, folder: str | pathlib.Path, *, keep: int = 2) -> None:
        self._manager = ocp.CheckpointManager(
            pathlib.Path(folder).absolute(),
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep, create=True, enable_async_checkpointing=False
            ),
        )

    def save(self, state: Stepped) -> None:
        """Saves a state under its step number, atomically; Ctrl-C waits for that.

        Raises:
            PhysXNetError: A later checkpoint exists.
        """
        if self._manager.latest_step() == int(state.step):
            return
        with uninterrupted():
            saved = self._manager.save(
                int(state.step),
                args=ocp.args.Composite(state=ocp.args.StandardSave(_plain(state))),
            )
            self._manager.wait_until_finished()
        if not saved:
            raise PhysXNetError(
                f"{self._manager.directory}: step {int(state.step)} wasn't saved, because step"
                f" {self._manager.latest_step()} exists. Delete it, or choose another folder."
            )

    def forget_after(self, step: int) -> None:
        """Deletes checkpoints of later steps: a resumed run repeats those steps."""
        for later in self._manager.all_steps():
            if later > step:
                self._manager.delete(later)

    def latest(self, like: State) -> State | None:
        """The newest state, structured like ``like``; None if there is none.

        Raises:
            PhysXNetError: The checkpoint is damaged.
        """
        step = self._manager.latest_step()
        if step is None:
            return None
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, _plain(like))
        request = ocp.args.Composite(state=ocp.args.StandardRestore(abstract))
        try:
            restored = self._manager.restore(step, args=request)
        # Several libraries read the files, each with its own exception types.
        except Exception as error:
            raise PhysXNetError(
                f"{self._manager.directory}/{step}: the checkpoint is damaged"
                f" ({type(error).__name__}). Delete that folder: the run resumes from the"
                " previous one."
            ) from error
        return jax.tree.unflatten(jax.tree.structure(like), restored["state"])

    def close(self) -> None:
        """Waits for pending writes and closes the checkpoints."""
        self._manager.close()


def _plain(state: Stepped) -> list[Any]:
    """The leaves in order; their structure comes from the config, not from disk."""
    return jax.tree.leaves(state)


def config_json(config: Any, data: str) -> str:
    """A run as JSON: its config and the identity of its training data.

    Without ``blend``, which acts when the run is over.
    """
    run = {k: v for k, v in dataclasses.asdict(config).items() if k != "blend"}
    return json.dumps({**run, "data": data}, indent=1, sort_keys=True)
