"""Datasets: the protocol's actions, simulated cloth on disk, batches."""

from ._build import build_dataset as build_dataset, skinned_cloth as skinned_cloth
from ._protocol import (
    FPS as FPS,
    Action as Action,
    load_action as load_action,
    read_protocol as read_protocol,
)
from ._store import (
    Sequence as Sequence,
    list_sequences as list_sequences,
    read_offsets as read_offsets,
    read_sequence as read_sequence,
    write_action as write_action,
    write_offsets as write_offsets,
)
