"""Trained predictors on disk: safetensors and a JSON card, tied to their atlas."""

import dataclasses
import hashlib
import importlib.resources
import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from safetensors.numpy import load as load_tensors, save as save_tensors

from ..body import load_body
from ..errors import WeightsError
from ..files import atomic_write
from ..uv import make_atlas
from ._features import FeatureConfig
from ._networks import Generator
from ._predictor import (
    ModelConfig,
    Normalisation,
    Predictor,
    make_generator,
    make_texel_points,
)

DEFAULT = "base"
"""Name of the default weights."""
_TENSORS, _CARD = "weights.safetensors", "card.json"
_PACKAGED = pathlib.Path(str(importlib.resources.files(__package__ or "") / "weights"))


def save_predictor(
    folder: str | pathlib.Path,
    predictor: Predictor,
    *,
    name: str,
    card: dict[str, Any] | None = None,
) -> None:
    """Writes a predictor: half-precision weights, masks, and a card.

    Args:
        folder: Folder for ``weights.safetensors`` and ``card.json``.
        predictor: The predictor to write.
        name: Its name.
        card: Further entries of the card: data, licence, measured table.

    Raises:
        WeightsError: The predictor can't be saved: its batch norm is folded, or it uses
            test-time augmentation. Or parameters exceed half precision.
    """
    folder = pathlib.Path(folder)
    network = nnx.merge(predictor.graph, predictor.state)
    custom = None if isinstance(network, Generator) else type(network).__qualname__
    plain = nnx.eval_shape(lambda: make_generator(predictor.config))
    same = jax.tree.structure(nnx.state(network)) == jax.tree.structure(nnx.state(plain))
    if custom is None and not same:
        raise WeightsError(
            f"{name}: this network has been folded (as in a dresser); train and save the"
            " predictor that was loaded, as in examples/05_fine_tune.py."
        )
    if predictor.mirror_tta:
        raise WeightsError(
            f"{name}: save the predictor without test-time augmentation, and request that with"
            " Inference(tta=True)."
        )
    tensors: dict[str, np.ndarray] = {}
    leaves = jax.tree.leaves(predictor.state)
    for parameter, x in zip(_parameters(predictor.state), leaves, strict=True):
        # Batch statistics stay float32: a variance may exceed the range of float16.
        kernel = parameter.endswith("kernel")
        tensors[parameter] = np.asarray(x).astype(np.float16 if kernel else np.float32)
        if not np.isfinite(tensors[parameter]).all():
            raise WeightsError(f"{name}: {parameter} isn't finite in half precision.")
    for t, mask in predictor.texel_points.valid.items():
        tensors[f"valid_{t}"] = np.packbits(np.asarray(mask))
    blob = save_tensors(tensors)
    n = predictor.normalisation
    info = {
        "name": name,
        "model": dataclasses.asdict(predictor.config),
        "normalisation": {
            "velocity": float(n.velocity),
            "acceleration": float(n.acceleration),
            "offset": {t: float(v) for t, v in n.offset.items()},
        },
        "atlas": predictor.atlas.digest(),
        "sha256": hashlib.sha256(blob).hexdigest(),
        **({} if custom is None else {"network": custom}),
        **(card or {}),
    }
    for file, data in ((_TENSORS, blob), (_CARD, json.dumps(info, indent=1).encode())):
        with atomic_write(folder / file) as part:
            part.write_bytes(data)


def list_weights() -> list[str]:
    """Names of the packaged weights."""
    if not _PACKAGED.is_dir():
        return []
    return sorted(p.name for p in _PACKAGED.iterdir() if (p / _CARD).is_file())


def read_card(weights: str | pathlib.Path = DEFAULT) -> dict[str, Any]:
    """Reads the card of weights, by name or folder.

    Raises:
        WeightsError: Unknown name or invalid card.
    """
    path = _folder(weights) / _CARD
    try:
        card = json.loads(path.read_text(), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise WeightsError(
            f"{path}: not a card, it is damaged ({error}). Reinstall or copy it again."
        ) from None
    if not isinstance(card, dict):
        raise WeightsError(f"{path}: not a card, it is damaged. Reinstall or copy it again.")
    return card


def _refuse_constant(word: str) -> None:
    raise ValueError(f"{word} isn't a number")


def weights_size(weights: str | pathlib.Path = DEFAULT) -> int:
    """Size of a network's tensors on disk in bytes.

    Raises:
        WeightsError: Unknown name, invalid card or missing tensors.
    """
    read_card(weights)
    path = _folder(weights) / _TENSORS
    if not path.is_file():
        raise WeightsError(f"{path}: no such file. Reinstall or copy it again.")
    return path.stat().st_size


def load_predictor(
    weights: str | pathlib.Path = DEFAULT, *, network: nnx.Module | None = None
) -> Predictor:
    """Loads a predictor by the name of packaged weights, or from a folder.

    Args:
        weights: A name of `list_weights`, or a folder that `save_predictor` wrote.
        network: A module of the same structure, for weights of a custom network.

    Returns:
        The predictor, on the built-in body's default shape.

    Raises:
        WeightsError: Unknown name, damaged file, or an atlas other than the one the
            weights were trained on.
    """
    folder = _folder(weights)
    try:
        predictor = _load(weights, folder, network)
    except WeightsError:
        raise
    # A damaged card may raise any error, and safetensors has its own exception types.
    except Exception as error:
        raise WeightsError(
            f"{weights}: the card or the tensors are damaged ({type(error).__name__}:"
            f" {str(error)[:200]}). Reinstall or copy them again."
        ) from error
    return predictor


def _model(card: dict[str, Any]) -> ModelConfig:
    names = {k: tuple(card[k]) for k in ("templates", "fabrics") if k in card}
    return ModelConfig(**{**card, **names, "inputs": FeatureConfig(**card["inputs"])})


def _load(
    weights: str | pathlib.Path, folder: pathlib.Path, custom: nnx.Module | None = None
) -> Predictor:
    card = read_card(weights)
    blob = (folder / _TENSORS).read_bytes()
    digest = hashlib.sha256(blob).hexdigest()
    if digest != card["sha256"]:
        raise WeightsError(
            f"{weights}: sha256 is {digest[:12]}…, the card states {card['sha256'][:12]}…;"
            " the file is damaged. Reinstall or copy it again."
        )
    tensors = load_tensors(blob)
    model = _model(card["model"])
    inputs = model.inputs
    sizes = (model.resolution, model.width, inputs.frames, inputs.stride)
    if not all(type(n) is int and 0 < n <= 1024 for n in sizes):
        raise WeightsError(
            f"{weights}: the card declares {model.resolution} texels per side, width"
            f" {model.width}, {inputs.frames} frames. Copy it again."
        )
    # Shapes only: drawing random parameters that are replaced right away takes seconds.
    if custom is None and "network" in card:
        raise WeightsError(
            f"{weights}: weights of the custom network {card['network']}; pass one as"
            " load_predictor(..., network=...), and the predictor as weights."
        )
    network: Any = nnx.eval_shape(lambda: make_generator(model)) if custom is None else custom
    network.eval()
    graph, state = nnx.split(network)
    # The tensors must be concrete arrays, even inside a traced function.
    with jax.ensure_compile_time_eval():
        return _filled(weights, card, model, tensors, graph, state)


def _check_finite(weights: str | pathlib.Path, name: str, x: Any, above: float = -np.inf) -> None:
    values = np.asarray(x, np.float64)
    # False for NaN too.
    finite = np.abs(values) <= np.finfo(np.float32).max
    if not (finite & (values > above)).all():
        raise WeightsError(
            f"{weights}: {name} has values that aren't {'positive' if above == 0.0 else 'finite'}."
            " The training failed, or the file is damaged: use another checkpoint."
        )


def _filled(
    weights: str | pathlib.Path,
    card: dict[str, Any],
    model: ModelConfig,
    tensors: dict[str, np.ndarray],
    graph: Any,
    state: Any,
) -> Predictor:
    """Fills a network's structure with the tensors of its file."""
    atlas = make_atlas(model.resolution, skirt=model.skirt_chart)
    coarse = make_atlas(model.motion_resolution, skirt=True) if model.finer else None
    if atlas.digest() != card["atlas"]:
        raise WeightsError(
            f"{weights}: trained on atlas {card['atlas']}, this version makes"
            f" {atlas.digest()}. Use the package version that the weights came with."
        )
    like, structure = jax.tree.flatten(state)
    leaves = []
    for parameter, y in zip(_parameters(state), like, strict=True):
        x = tensors.get(parameter)
        if x is None or x.shape != y.shape:
            found = "isn't there" if x is None else f"has shape {x.shape}"
            raise WeightsError(
                f"{weights}: {parameter} {found}; {y.shape} is expected. Use the package version"
                " that the weights came with."
            )
        _check_finite(weights, parameter, x)
        leaves.append(x)
    state = jax.tree.unflatten(
        structure, [jax.device_put(x.astype(y.dtype)) for x, y in zip(leaves, like, strict=True)]
    )
    valid = {
        t: jax.device_put(np.unpackbits(tensors[f"valid_{t}"])[: atlas.num_texels].astype(bool))
        for t in model.templates
    }
    n = card["normalisation"]
    for key, value in {**n, **n["offset"], "offset": 1.0}.items():
        _check_finite(weights, f"normalisation by {key}", value, above=0.0)
    normalisation = Normalisation(
        jnp.float32(n["velocity"]),
        jnp.float32(n["acceleration"]),
        {t: jnp.float32(v) for t, v in n["offset"].items()},
    )
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    texel_points = make_texel_points(coarse or atlas, body, rest, valid)
    return Predictor(atlas, texel_points, normalisation, state, graph, model, coarse_atlas=coarse)


def _parameters(state: Any) -> list[str]:
    """Parameter names such as ``encoder.layers.0.kernel``, in the order of the network's leaves."""
    paths = jax.tree_util.tree_leaves_with_path(state)
    names = [jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in paths]
    return [n.removesuffix(".value") for n in names]


def _folder(weights: str | pathlib.Path) -> pathlib.Path:
    name = str(weights)
    path = pathlib.Path(name)
    if (path / _CARD).is_file():
        return path
    packaged = _PACKAGED / name
    if not (packaged / _CARD).is_file():
        raise WeightsError(
            f"No weights '{weights}': neither a folder with {_CARD} nor one of"
            f" {', '.join(list_weights()) or 'none in this package'}."
        )
    return packaged
