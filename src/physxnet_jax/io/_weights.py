"""Trained predictors on disk: safetensors and a JSON card, tied to their atlas."""

import dataclasses
import hashlib
import importlib.resources
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from safetensors.numpy import load as load_tensors, save as save_tensors

from ..body import load_body
from ..errors import WeightsError
from ..files import whole_file
from ..models import (
    Inputs,
    MeanGenerator,
    ModelConfig,
    Normalisation,
    Predictor,
    ask_mirrored,
    average_networks,
    make_generator,
    make_surface,
    relax_cloth,
)
from ..uv import make_atlas

DEFAULT = "local+relax"
MIRROR = "+mirror"
"""Behind the name of weights: the network is asked for the mirrored person too."""
RELAX = "+relax"
"""Behind the name of weights: cloth is brought back to the lengths of its edges."""
_WAYS = {MIRROR: ask_mirrored, RELAX: relax_cloth}
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
        folder: Where ``weights.safetensors`` and ``card.json`` go.
        predictor: What to write.
        name: Its name.
        card: Anything else to tell: data, licence, measured table.

    Raises:
        WeightsError: A predictor that couldn't be read again: its network is a mean, its
            batch norm is folded, it asks for the mirrored person or relaxes cloth (save
            it without, and call the weights with ``+mirror`` or ``+relax``). Or
            parameters beyond half precision.
    """
    folder = pathlib.Path(folder)
    network = nnx.merge(predictor.graph, predictor.state)
    if isinstance(network, MeanGenerator):
        raise WeightsError(f"{name}: a mean of networks isn't saved; save the networks.")
    plain = nnx.eval_shape(lambda: make_generator(predictor.config))
    if jax.tree.structure(nnx.state(network)) != jax.tree.structure(nnx.state(plain)):
        raise WeightsError(
            f"{name}: this network has been folded (as a dresser's is) or is none of"
            " make_generator's; teach and save the predictor that was loaded, as in"
            " examples/05_fine_tune.py."
        )
    if predictor.mirrored or predictor.relaxation:
        raise WeightsError(
            f"{name}: a predictor that asks for the mirrored person or relaxes cloth is saved"
            f" without that; name the weights with {MIRROR} or {RELAX} when they are loaded."
        )
    tensors: dict[str, np.ndarray] = {}
    leaves = jax.tree.leaves(predictor.state)
    for parameter, x in zip(_parameters(predictor.state), leaves, strict=True):
        # Batch statistics keep float32: a variance may leave the range of float16.
        kernel = parameter.endswith("kernel")
        tensors[parameter] = np.asarray(x).astype(np.float16 if kernel else np.float32)
        if not np.isfinite(tensors[parameter]).all():
            raise WeightsError(f"{name}: {parameter} isn't finite in half precision.")
    for t, mask in predictor.surface.valid.items():
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
        **(card or {}),
    }
    for file, data in ((_TENSORS, blob), (_CARD, json.dumps(info, indent=1).encode())):
        with whole_file(folder / file) as part:
            part.write_bytes(data)


def save_mean(
    folder: str | pathlib.Path, parts: Sequence[str], *, card: dict[str, Any] | None = None
) -> None:
    """Writes the card of packaged networks whose answers are averaged: it has no tensors.

    Args:
        folder: Where ``card.json`` goes; its name is theirs together.
        parts: Names of `list_weights`.
        card: Anything else to tell: licence, measured table.
    """
    folder = pathlib.Path(folder)
    digest = _digest([read_card(p) for p in parts])
    info = {"name": folder.name, "mean_of": list(parts), "sha256": digest, **(card or {})}
    with whole_file(folder / _CARD) as part:
        part.write_text(json.dumps(info, indent=1))


def _digest(cards: Sequence[dict[str, Any]]) -> str:
    return hashlib.sha256("".join(c["sha256"] for c in cards).encode()).hexdigest()


def list_weights() -> list[str]:
    """Names of the weights in the package."""
    if not _PACKAGED.is_dir():
        return []
    return sorted(p.name for p in _PACKAGED.iterdir() if (p / _CARD).is_file())


def read_card(weights: str | pathlib.Path = DEFAULT) -> dict[str, Any]:
    """The card of weights by name or folder.

    Raises:
        WeightsError: Unknown name, or a card that isn't one.
    """
    path = _folder(weights) / _CARD
    try:
        card = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: not a card ({error}). Reinstall or copy it again.") from None
    if not isinstance(card, dict):
        raise WeightsError(f"{path}: not a card. Reinstall or copy it again.")
    return card


def weights_size(weights: str | pathlib.Path = DEFAULT) -> int:
    """Bytes of a network's tensors on disk.

    Raises:
        WeightsError: Unknown name, a card that isn't one, or no tensors beside it.
    """
    folder = _folder(weights)
    files = [f / _TENSORS for f in _parts(read_card(weights)) or [folder]]
    if missing := [f for f in files if not f.is_file()]:
        raise WeightsError(f"{missing[0]}: no such file. Reinstall or copy it again.")
    return sum(f.stat().st_size for f in files)


def load_predictor(weights: str | pathlib.Path = DEFAULT) -> Predictor:
    """A predictor by the name of packaged weights, or from a folder.

    Args:
        weights: A name of `list_weights`, or a folder that `save_predictor` wrote. With
            ``+mirror`` behind it, see `ask_mirrored`; with ``+relax``, see `relax_cloth`.

    Returns:
        The predictor, on the built-in body's default shape.

    Raises:
        WeightsError: Unknown name, damaged file, or an atlas other than the one the
            weights were trained on.
    """
    folder = _folder(weights)
    try:
        predictor = _load(weights, folder)
    except WeightsError:
        raise
    # A damaged card may hold anything anywhere; safetensors has errors of its own.
    except Exception as error:
        raise WeightsError(
            f"{weights}: the card or the tensors are damaged ({type(error).__name__}:"
            f" {str(error)[:200]}). Reinstall or copy them again."
        ) from error
    try:
        for way in split_ways(weights)[1]:
            predictor = _WAYS[way](predictor)
    except ValueError as error:
        raise WeightsError(f"{weights}: {error}") from None
    return predictor


def split_ways(weights: str | pathlib.Path) -> tuple[str, tuple[str, ...]]:
    """The name or folder of weights, and the ways behind it in which they are used.

    >>> split_ways("local+mirror+relax")
    ('local', ('+mirror', '+relax'))
    """
    name, ways = str(weights), []
    while way := next((w for w in _WAYS if name.endswith(w) and w not in ways), None):
        name = name.removesuffix(way)
        ways.insert(0, way)
    return name, tuple(ways)


def _model(card: dict[str, Any]) -> ModelConfig:
    return ModelConfig(
        **{**card, "templates": tuple(card["templates"]), "inputs": Inputs(**card["inputs"])}
    )


def _parts(card: dict[str, Any]) -> list[pathlib.Path]:
    """Folders of the packaged networks whose answers are averaged; mostly none."""
    told = card.get("mean_of", ())
    named = told if isinstance(told, list) else []
    return [_PACKAGED / name for name in named if name in list_weights()]


def _load(weights: str | pathlib.Path, folder: pathlib.Path) -> Predictor:
    card = json.loads((folder / _CARD).read_text())
    if "mean_of" in card:
        parts = _parts(card)
        told = [json.loads((p / _CARD).read_text()) for p in parts]
        if _digest(told) != card["sha256"] or any("mean_of" in c for c in told):
            raise WeightsError(
                f"{weights}: {', '.join(map(str, card['mean_of']))} aren't the networks of this"
                " card. Reinstall the package."
            )
        return average_networks([_load(p.name, p) for p in parts])
    blob = (folder / _TENSORS).read_bytes()
    digest = hashlib.sha256(blob).hexdigest()
    if digest != card["sha256"]:
        raise WeightsError(
            f"{weights}: sha256 is {digest[:12]}…, the card says {card['sha256'][:12]}…;"
            " the file is damaged. Reinstall or copy it again."
        )
    tensors = load_tensors(blob)
    model = _model(card["model"])
    inputs = model.inputs
    sizes = (model.resolution, model.width, inputs.frames, inputs.stride)
    if not all(type(n) is int and 0 < n <= 1024 for n in sizes):
        raise WeightsError(
            f"{weights}: the card speaks of {model.resolution} texels a side, width"
            f" {model.width}, {inputs.frames} frames. Copy it again."
        )
    # Shapes alone, and before anything is evaluated: drawing random parameters only to
    # replace them takes seconds.
    network = nnx.eval_shape(lambda: make_generator(model))
    network.eval()
    graph, state = nnx.split(network)
    # Numbers of a file, wherever they are asked for: inside a traced function too.
    with jax.ensure_compile_time_eval():
        return _filled(weights, card, model, tensors, graph, state)


def _filled(
    weights: str | pathlib.Path,
    card: dict[str, Any],
    model: ModelConfig,
    tensors: dict[str, np.ndarray],
    graph: Any,
    state: Any,
) -> Predictor:
    """A network's structure with the numbers of its file."""
    atlas = make_atlas(model.resolution)
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
        leaves.append(x)
    state = jax.tree.unflatten(
        structure, [jnp.asarray(x.astype(y.dtype)) for x, y in zip(leaves, like, strict=True)]
    )
    valid = {
        t: jnp.asarray(np.unpackbits(tensors[f"valid_{t}"])[: atlas.num_texels].astype(bool))
        for t in model.templates
    }
    n = card["normalisation"]
    normalisation = Normalisation(
        jnp.float32(n["velocity"]),
        jnp.float32(n["acceleration"]),
        {t: jnp.float32(v) for t, v in n["offset"].items()},
    )
    body = load_body()
    surface = make_surface(atlas, body, body.rest_vertices(body.default_shape()), valid)
    return Predictor(atlas, surface, normalisation, state, graph, model)


def _parameters(state: Any) -> list[str]:
    """Names of a network's parameters, ``encoder.layers.0.kernel``, in the order of its leaves."""
    paths = jax.tree_util.tree_leaves_with_path(state)
    names = [jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in paths]
    return [n.removesuffix(".value") for n in names]


def _folder(weights: str | pathlib.Path) -> pathlib.Path:
    name, _ = split_ways(weights)
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
