"""Checks of settings objects."""

import dataclasses
import math

import pytest

from physxnet_jax.errors import check_flags, check_numbers, check_vector


@dataclasses.dataclass
class Settings:
    size: object = 1.0
    share: "float | None" = None
    ready: object = True
    wind: object = (0.0, 1, -2.5)


def test_right_values_pass():
    check_numbers(Settings(), "size", "share")
    check_flags(Settings(), "ready")
    check_vector(Settings(), "wind")
    check_vector(Settings(wind=[1, 2, 3]), "wind")


@pytest.mark.parametrize("size", [None, True, "1", 0.0, -1, math.nan, math.inf, (1.0,)])
def test_what_is_no_positive_number_is_named(size):
    with pytest.raises(ValueError, match="size is"):
        check_numbers(Settings(size=size), "size")


@pytest.mark.parametrize("ready", [None, 1, "no"])
def test_what_is_no_flag_is_named(ready):
    with pytest.raises(ValueError, match="ready is"):
        check_flags(Settings(ready=ready), "ready")


@pytest.mark.parametrize("wind", [None, 3.0, (1.0, 2.0), (1.0, 2.0, math.nan), "abc"])
def test_what_is_no_vector_is_named(wind):
    with pytest.raises(ValueError, match="wind is"):
        check_vector(Settings(wind=wind), "wind")
