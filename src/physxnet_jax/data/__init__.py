"""Datasets: the protocol's actions, simulated cloth on disk, batches."""

from ._build import build_dataset as build_dataset, expected_frames as expected_frames
from ._codec import make_codec as make_codec
from ._config import CARD as CARD, DatasetConfig as DatasetConfig
from ._frames import (
    Frames as Frames,
    is_trainable as is_trainable,
    load_frames as load_frames,
    pose_windows as pose_windows,
    take as take,
    usable_garment as usable_garment,
)
from ._garment_stream import (
    TemplateStreams as TemplateStreams,
    join_templates as join_templates,
)
from ._mirror import mirrored_offsets as mirrored_offsets, mirrored_sequence as mirrored_sequence
from ._outfit import (
    Clothing as Clothing,
    Outfit as Outfit,
    Worn as Worn,
    garment_of as garment_of,
    person_shape as person_shape,
    shape_of as shape_of,
)
from ._protocol import (
    Action as Action,
    left_out as left_out,
    load_action as load_action,
    read_protocol as read_protocol,
    write_protocol as write_protocol,
)
from ._store import (
    QUANTIZATION_STEP as QUANTIZATION_STEP,
    Sequence as Sequence,
    Where as Where,
    dataset_digest as dataset_digest,
    list_sequences as list_sequences,
    open_dataset as open_dataset,
    read_note as read_note,
    read_sequence as read_sequence,
    read_times as read_times,
    write_action as write_action,
    write_garment as write_garment,
    write_offsets as write_offsets,
)
from ._stream import (
    Batches as Batches,
    Entry as Entry,
    FrameStream as FrameStream,
    list_entries as list_entries,
    read_entry as read_entry,
)
from ._wardrobe import Wardrobe as Wardrobe, make_wardrobe as make_wardrobe
