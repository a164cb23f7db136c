"""The effects of a scene follow from what is worn."""

import pytest

from physxnet_jax.garment import tailor, template
from physxnet_jax.simulation import STANDARD, standard_effects
from physxnet_jax.simulation.effects import Elastic, LayerContact, Membrane, Stretch


def test_a_template_calls_for_nothing_more():
    assert standard_effects((template("top"),)) == STANDARD


def test_bands_and_layers_call_for_their_effects():
    kinds = {type(e) for e in standard_effects((tailor("shorts"), template("top")))}
    assert {Elastic, LayerContact} <= kinds


@pytest.mark.parametrize(("fabric", "law"), [("cotton", Stretch), ("silk", Membrane)])
def test_fabrics_with_warp_and_weft_call_for_the_membrane(fabric, law):
    both = {type(e) for e in standard_effects((tailor("shorts", fabric=fabric),))}
    assert both & {Stretch, Membrane} == {law}
    # One garment of such a fabric is enough.
    mixed = (tailor("shorts"), tailor("shorts", fabric=fabric))
    assert law in {type(e) for e in standard_effects(mixed)}
