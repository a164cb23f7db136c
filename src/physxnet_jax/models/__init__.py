"""Networks and the predictor built on them. Knows nothing of losses or files."""

from ._blocks import (
    Up as Up,
    upsample as upsample,
    upsampling_kernel as upsampling_kernel,
)
from ._features import (
    PAPER as PAPER,
    Family as Family,
    Inputs as Inputs,
    clip_features as clip_features,
    point_features as point_features,
    skin_points as skin_points,
)
from ._fold import at_precision as at_precision, fold_batch_norm as fold_batch_norm
from ._mean import MeanGenerator as MeanGenerator, average_networks as average_networks
from ._networks import Discriminator as Discriminator, Generator as Generator
from ._predictor import (
    RELAXATION as RELAXATION,
    ModelConfig as ModelConfig,
    Normalisation as Normalisation,
    Predictor as Predictor,
    Surface as Surface,
    ask_mirrored as ask_mirrored,
    make_generator as make_generator,
    make_surface as make_surface,
    normalise as normalise,
    relax_cloth as relax_cloth,
)
from ._stream import (
    Stream as Stream,
    start_stream as start_stream,
    stream_frame as stream_frame,
)
from ._wearable import (
    Wearable as Wearable,
    apply_offsets as apply_offsets,
    dress_frames as dress_frames,
    make_wearable as make_wearable,
    pad_clip as pad_clip,
    pose_windows as pose_windows,
    skin_wearable as skin_wearable,
)
