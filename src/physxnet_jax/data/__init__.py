"""Datasets: the protocol's actions, simulated cloth on disk, batches."""

from ._build import (
    build_dataset as build_dataset,
    expected_frames as expected_frames,
    skinned_cloth as skinned_cloth,
)
from ._codec import Codec as Codec, make_codec as make_codec
from ._config import CARD as CARD, DatasetConfig as DatasetConfig
from ._mirror import (
    mirrored_offsets as mirrored_offsets,
    mirrored_sequence as mirrored_sequence,
)
from ._protocol import (
    FPS as FPS,
    Action as Action,
    left_out as left_out,
    load_action as load_action,
    read_protocol as read_protocol,
)
from ._store import (
    QUANTUM as QUANTUM,
    Sequence as Sequence,
    dataset_digest as dataset_digest,
    list_sequences as list_sequences,
    open_dataset as open_dataset,
    read_log as read_log,
    read_note as read_note,
    read_offsets as read_offsets,
    read_sequence as read_sequence,
    write_action as write_action,
    write_garment as write_garment,
    write_offsets as write_offsets,
)
