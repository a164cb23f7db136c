"""Names of methods in rows of tables, and what their suffixes stand for."""

import dataclasses
import pathlib
import re
from collections.abc import Sequence

from ..dressing import EXTERNAL_ENGINES, Inference
from ..errors import PhysXNetError
from ..garment import Template
from ..models import load_predictor
from ..simulation import PRESETS
from ._methods import PERTURBATION, Guided, Method, Simulator, external_engine, network, skinning

MIRROR, RELAX, PUSH, GUIDED = "+mirror", "+relax", "+push", "+guided"
"""Suffixes of rows: test-time augmentation, strain limiting, collision resolution, guided
simulation."""
_SIMULATED = re.compile(r"\+(guided|unguided)(\d*)$")


def parse_method(name: str) -> Inference:
    """The options of a network's row: ``WEIGHTS[+mirror][+relax][+push]``.

    What follows ``+guided`` or ``+unguided`` isn't the network's and is left out.

    Args:
        name: Name or folder of weights or of a run, with its suffixes.

    Example:
        >>> parse_method("nano+mirror+push")
        Inference(weights='nano', tta=True, strain_iterations=0, collisions=True)
    """
    found, name = [], _SIMULATED.sub("", name)
    for suffix in (PUSH, RELAX, MIRROR):
        if name.endswith(suffix):
            name = name.removesuffix(suffix)
            found.append(suffix)
    run = pathlib.Path(name) / "weights"
    return Inference(
        weights=str(run) if run.is_dir() else name,
        tta=MIRROR in found,
        strain_iterations=Inference().strain_iterations if RELAX in found else 0,
        collisions=PUSH in found,
    )


def method_name(inference: Inference) -> str:
    """The name of a network's row; `parse_method` reads it.

    Example:
        >>> method_name(Inference())
        'base+relax+push'
    """
    return "".join(
        (
            str(inference.weights),
            MIRROR if inference.tta else "",
            RELAX if inference.strain_iterations else "",
            PUSH if inference.collisions else "",
        )
    )


def method_by_name(name: str, templates: Sequence[Template] = ()) -> Method:
    """A method by the name of its row.

    ``perturbed`` is the simulator with a root perturbed by `PERTURBATION`. Its distance to the
    unperturbed run is the smallest meaningful error. ``+guided16`` after a network is a guided
    simulation with 16 substeps, ``+unguided16`` the same without a guide.

    Args:
        name: ``lbs``, ``perturbed``, an accuracy of the simulator, an external engine, or a
            network as in `parse_method`.
        templates: Templates that a network must have decoders for.

    Raises:
        WeightsError: There are no such weights.
        PhysXNetError: The network lacks a decoder.
    """
    if name == "lbs":
        return skinning()
    if name == "perturbed":
        return Simulator("standard", moved=PERTURBATION)
    if name in PRESETS:
        return Simulator(name)
    if name in EXTERNAL_ENGINES:
        return external_engine(name)
    inference = parse_method(name)
    # Wrong weights are reported before a long computation starts.
    predictor = load_predictor(str(inference.weights))
    missing = set(templates) - set(predictor.config.templates)
    if missing:
        raise PhysXNetError(
            f"{name} has no decoder for {', '.join(sorted(missing))}; leave them out."
        )
    loaded = dataclasses.replace(inference, weights=predictor)
    simulated = _SIMULATED.search(name)
    if simulated is None:
        return network(loaded)
    kind, substeps = simulated.groups()
    return Guided(loaded, int(substeps) if substeps else None, free=kind == "unguided")
