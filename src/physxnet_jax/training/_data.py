"""What a run learns from: frames, tables and scales."""

import dataclasses
import functools
from collections.abc import Sequence as Items

from ..body import load_body
from ..data import (
    Entry,
    Frames,
    FrameStream,
    Sequence,
    TemplateStreams,
    Wardrobe,
    Where,
    load_frames,
    make_wardrobe,
    mirrored_sequence,
    read_entry,
)
from ..errors import FormatError
from ..models import Normalisation, TexelPoints
from ..uv import Atlas
from ._config import TrainConfig
from ._garment_tables import (
    GarmentTables,
    Persons,
    measure_garment_normalisation,
    prepare_garments,
)
from ._targets import ClothTables, measure_normalisation, prepare_targets


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingData:
    """Frames to learn from, and the tables and scales that come with them."""

    frames: FrameStream | TemplateStreams
    unseen: Frames | dict[str, Frames] | None
    atlas: Atlas
    texel_points: TexelPoints
    tables: dict[str, ClothTables] | dict[str, GarmentTables]
    persons: Persons | None
    motion_atlas: Atlas
    normalisation: Normalisation


def load_data(config: TrainConfig, sequences: Items[Sequence | Where | Entry]) -> TrainingData:
    """Divides actions into those to learn from and those to validate on, and prepares both.

    Raises:
        FormatError: No usable data for training or validation.
    """
    body, model = load_body(), config.model
    entries = [read_entry(s) for s in sequences]
    wardrobe = make_wardrobe([e.outfit for e in entries], config.templates)
    if not model.conditions and any(wardrobe.outfits):
        raise FormatError("these data hold outfits; learn from them with conditions = true.")
    held = _held_out(config, entries)
    used = [e for e in entries if e.action not in config.validation]
    if config.mirror_augmentation:
        used += [dataclasses.replace(e, mirrored=True) for e in used]

    def frames_of(seen: Wardrobe, capacity: int) -> tuple[FrameStream, Frames | None]:
        """Frames to learn from and to validate on, of those who wear something of a wardrobe."""
        load = functools.partial(
            load_frames,
            wardrobe=seen,
            body=body,
            window=model.inputs.window,
            local=model.family == "local",
        )
        worn = {e for t, e in seen.numbers if t in seen.garments}
        stream = FrameStream(
            [e for e in used if e.outfit in worn],
            load,
            functools.partial(mirrored_sequence, body),
            batch=config.batch,
            seed=config.seed,
            capacity=capacity,
        )
        unseen = [e.read() for e in held if e.outfit in worn]
        return stream, load(unseen) if unseen else None

    if not model.conditions:
        stream, unseen = frames_of(wardrobe, config.frames_in_memory)
        _check_usable(config, [unseen])
        atlas, points, tables = prepare_targets(model)
        first = stream.first()
        scales = measure_normalisation(first, points, tables, model.family, seed=config.seed)
        return TrainingData(
            frames=stream,
            unseen=unseen,
            atlas=atlas,
            texel_points=points,
            tables=tables,
            persons=None,
            motion_atlas=atlas,
            normalisation=scales,
        )
    atlas, motion_atlas, points, persons, garments = prepare_garments(
        model, wardrobe, elastic=config.elastic_weight > 0
    )
    share = config.frames_in_memory // len(config.templates)
    each = {
        t: frames_of(dataclasses.replace(wardrobe, garments={t: wardrobe.garments[t]}), share)
        for t in config.templates
    }
    known = {t: u for t, (_, u) in each.items() if u is not None}
    _check_usable(config, list(known.values()))
    streams = TemplateStreams({t: s for t, (s, _) in each.items()})
    scales = measure_garment_normalisation(streams.first(), points, garments, seed=config.seed)
    return TrainingData(
        frames=streams,
        unseen=known if len(known) == len(each) else None,
        atlas=atlas,
        texel_points=points,
        tables=garments,
        persons=persons,
        motion_atlas=motion_atlas,
        normalisation=scales,
    )


def _check_usable(config: TrainConfig, unseen: Items[Frames | None]) -> None:
    known = [f for f in unseen if f is not None]
    if known and not any(x.any() for f in known for x in f.usable.values()):
        raise FormatError(
            f"no usable cloth in {', '.join(config.validation)}: validate on another action."
        )


def _held_out(config: TrainConfig, sequences: Items[Entry]) -> list[Entry]:
    names = {s.action for s in sequences}
    missing = [n for n in config.validation if n not in names]
    if missing:
        raise FormatError(
            f"validation actions {', '.join(missing)} aren't among the sequences:"
            f" {', '.join(sorted(names)) or 'none'}."
        )
    return [s for s in sequences if s.action in config.validation]
