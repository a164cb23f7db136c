"""The network with push-out, as evaluation asks for methods."""

import functools

import jax
from jaxtyping import Array

from ..body import load_body
from ..evaluation import Blockwise, network
from ..garment import Template, template
from ..models import Predictor, Wearable, dress_frames
from ._push_out import SkinPatch, make_patch, push_out

_Worn = tuple[Predictor, Wearable, SkinPatch]


def pushed_network(predictor: Predictor) -> Blockwise:
    """A trained network whose vertices are pushed out of the body."""
    plain = network(predictor)
    body = load_body()
    rest = body.rest_vertices(body.default_shape())

    @functools.cache
    def wear(name: Template) -> _Worn:
        predictor, worn = plain.wear(name)
        return predictor, worn, make_patch(body, rest, worn, template(name).mesh)

    return Blockwise(_block, wear, plain.lead)


@functools.partial(jax.jit, static_argnames=("fps",))
def _block(worn: _Worn, r: Array, t: Array, fps: float) -> Array:
    predictor, wearable, patch = worn
    cloth = dress_frames(predictor, [wearable], r, t, fps)[0]
    last = slice(predictor.config.inputs.window - 1, None)
    return jax.vmap(lambda p, a, b: push_out(patch, p, a, b))(cloth, r[last], t[last])
