"""Networks, the predictor built on them, and weights on disk; independent of training."""

from ._blocks import Up as Up, upsample as upsample, upsampling_kernel as upsampling_kernel
from ._bound_garment import (
    BoundGarment as BoundGarment,
    apply_offsets as apply_offsets,
    apply_sampled_offsets as apply_sampled_offsets,
    bind_garment as bind_garment,
    dress_frames as dress_frames,
    pad_clip as pad_clip,
    predict_sampled as predict_sampled,
)
from ._features import (
    PAPER as PAPER,
    Family as Family,
    FeatureConfig as FeatureConfig,
    clip_features as clip_features,
    point_features as point_features,
)
from ._fold import at_precision as at_precision, fold_batch_norm as fold_batch_norm
from ._networks import (
    Discriminator as Discriminator,
    Generator as Generator,
    Modulation as Modulation,
)
from ._predictor import (
    ModelConfig as ModelConfig,
    Normalisation as Normalisation,
    Predictor as Predictor,
    TexelPoints as TexelPoints,
    make_generator as make_generator,
    make_texel_points as make_texel_points,
    normalise as normalise,
    with_mirror_tta as with_mirror_tta,
)
from ._weights import (
    DEFAULT as DEFAULT,
    list_weights as list_weights,
    load_predictor as load_predictor,
    read_card as read_card,
    save_predictor as save_predictor,
    weights_size as weights_size,
)
