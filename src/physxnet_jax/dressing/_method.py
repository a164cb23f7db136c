"""The network with push-out, as evaluation asks for methods."""

import functools
import pathlib

import jax
from jaxtyping import Array

from ..body import load_body
from ..evaluation import ENGINES, NOISE, Blockwise, Method, Simulator, engine, network, skinning
from ..garment import Template, template
from ..geometry import each_frame
from ..io import load_predictor, split_ways
from ..models import Predictor, Wearable, dress_frames
from ..simulation import ACCURACY
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


def method_by_name(name: str) -> Method:
    """A way to dress by its name: ``lbs``, the simulator's accuracy, an engine's, a network's.

    ``noise`` is the simulator from almost the same start: how far two runs part that
    should be one is the least error that means anything.

    Args:
        name: A network is called by its weights' name or folder, or a run's folder; with
            ``+mirror`` behind it is asked for the mirrored person too (see
            `ask_mirrored`), with ``+relax`` its cloth is brought back to its lengths (see
            `relax_cloth`), with ``+push`` behind all its vertices are pushed out of the
            body.

    Raises:
        WeightsError: There are no such weights.
    """
    if name == "lbs":
        return skinning()
    if name == "noise":
        return Simulator("standard", moved=NOISE)
    if name in ACCURACY:
        return Simulator(name)
    if name in ENGINES:
        return engine(name)
    predictor = load_predictor(weights_folder(name.removesuffix("+push")))
    return pushed_network(predictor) if name.endswith("+push") else network(predictor)


def weights_folder(name: str) -> str:
    """Where a run keeps its weights; any other name as it is."""
    plain, ways = split_ways(name)
    run = pathlib.Path(plain) / "weights"
    return "".join((str(run), *ways)) if run.is_dir() else name


@functools.partial(jax.jit, static_argnames=("fps",))
def _block(worn: _Worn, r: Array, t: Array, fps: float) -> Array:
    predictor, wearable, patch = worn
    cloth = dress_frames(predictor, [wearable], r, t, fps)[0]
    last = slice(predictor.config.inputs.window - 1, None)
    return each_frame(functools.partial(push_out, patch), cloth, r[last], t[last])
