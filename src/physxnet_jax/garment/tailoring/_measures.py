"""What a tailor can make, and the measures of it."""

import dataclasses
from typing import Literal

from ...errors import PhysXNetError

Style = Literal["top", "strapless", "trousers", "skirt", "dress", "strapless-dress"]
MEASURES = ("ease", "length", "flare", "sleeve", "neckline")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Range:
    """Limits of a measure and its default [m]."""

    default: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of garment: its measures and what sets it apart beside them.

    Attributes:
        style: How it is cut.
        summary: One line for lists.
        ranges: Limits and defaults of its measures [m].
        classes: Upper ends of the lengths, and of the sleeves, that share one mesh [m].
        fabric: Name of its usual fabric.
        sleeve_ease: Ease of the upper arm over that of the chest [1].
        taper: How much narrower a sleeve is at the wrist than at the shoulder [1].
        hem: Width of a leg at the ankle over the thigh's [1].
        hip_ease: Ease of the hip over that of what ``ease`` measures [1].
        neck: Half the width of the neckline at the shoulder, from the neck [m].
        back: Depth of the neckline behind [m].
        round: Exponent of the neckline: 1 is a V, 2 an ellipse, more is square.
        elastic: Borders held by elastic.
    """

    style: Style
    summary: str
    ranges: dict[str, Range]
    classes: dict[str, tuple[float, ...]]
    fabric: str = "cotton"
    sleeve_ease: float = 0.8
    taper: float = 0.0
    hem: float = 1.0
    hip_ease: float = 1.0
    neck: float = 0.05
    back: float = 0.02
    round: float = 2.0
    elastic: tuple[str, ...] = ()


def _range(default: float, low: float, high: float) -> Range:
    return Range(default=default, low=low, high=high)


def _top(ease, length, sleeve, neckline, flare=(0.0, -0.04, 0.30)) -> dict[str, Range]:
    return {
        "ease": _range(*ease),
        "length": _range(*length),
        "flare": _range(*flare),
        "sleeve": _range(*sleeve),
        "neckline": _range(*neckline),
    }


_TOP_CLASSES = {"length": (0.50, 0.60), "sleeve": (0.30, 0.46)}
_SKIRT_CLASSES = {"length": (0.45, 0.65, 0.90)}
_DRESS_CLASSES = {"length": (0.85, 1.05, 1.25), "sleeve": (0.30, 0.46)}


# Default, least and greatest length of long trousers [m].
_LONG = (0.82, 0.60, 0.85)


def _trousers(summary: str, ease, length, flare, ends=(0.72, 0.85), **more) -> Kind:
    return Kind(
        style="trousers",
        summary=summary,
        ranges={"ease": _range(*ease), "length": _range(*length), "flare": _range(*flare)},
        classes={"length": ends},
        elastic=("waist",),
        **more,
    )


def _skirt(summary: str, ease, length, flare, **more) -> Kind:
    return Kind(
        style="skirt",
        summary=summary,
        ranges={"ease": _range(*ease), "length": _range(*length), "flare": _range(*flare)},
        classes=_SKIRT_CLASSES,
        elastic=("waist",),
        **more,
    )


def _dress(summary: str, ease, length, flare, **more) -> Kind:
    return Kind(
        style="dress",
        summary=summary,
        ranges=_top(ease, length, (0.18, 0.12, 0.46), (0.12, 0.04, 0.20), flare),
        classes=_DRESS_CLASSES,
        sleeve_ease=0.6,
        neck=0.06,
        **more,
    )


KINDS: dict[str, Kind] = {
    "tee": Kind(
        style="top",
        summary="T-shirt with short sleeves",
        ranges=_top((0.12, 0.04, 0.30), (0.55, 0.40, 0.60), (0.20, 0.12, 0.46), (0.08, 0.04, 0.18)),
        classes=_TOP_CLASSES,
        fabric="jersey",
    ),
    "shirt": Kind(
        style="top",
        summary="shirt with long sleeves",
        ranges=_top((0.10, 0.04, 0.30), (0.58, 0.40, 0.60), (0.44, 0.12, 0.46), (0.07, 0.04, 0.18)),
        classes=_TOP_CLASSES,
        taper=0.3,
    ),
    "loose": Kind(
        style="top",
        summary="wide top with half sleeves",
        ranges=_top(
            (0.26, 0.12, 0.40),
            (0.57, 0.40, 0.60),
            (0.28, 0.12, 0.46),
            (0.12, 0.04, 0.20),
            (0.10, 0.0, 0.40),
        ),
        classes=_TOP_CLASSES,
        sleeve_ease=0.7,
        neck=0.06,
    ),
    "strapless": Kind(
        style="strapless",
        summary="strapless top held by elastic",
        ranges={
            "ease": _range(0.04, 0.035, 0.10),
            "length": _range(0.34, 0.24, 0.43),
            "flare": _range(0.06, 0.0, 0.40),
        },
        classes={"length": (0.43,)},
        elastic=("top",),
    ),
    "slim": _trousers(
        "slim trousers", (0.055, 0.05, 0.09), _LONG, (0.0, -0.03, 0.15), fabric="denim", hem=0.6
    ),
    "trousers": _trousers(
        "straight trousers", (0.06, 0.05, 0.16), _LONG, (0.0, -0.06, 0.30), hem=0.8
    ),
    "wide": _trousers("wide trousers", (0.14, 0.08, 0.26), _LONG, (0.06, 0.0, 0.30), hip_ease=0.8),
    "shorts": _trousers(
        "shorts",
        (0.10, 0.05, 0.24),
        (0.42, 0.36, 0.60),
        (0.0, -0.02, 0.30),
        ends=(0.48, 0.60),
        hip_ease=0.8,
    ),
    "pencil-skirt": _skirt(
        "narrow skirt", (0.05, 0.03, 0.12), (0.56, 0.32, 0.75), (0.0, -0.04, 0.10), fabric="denim"
    ),
    "skirt": _skirt("A-line skirt", (0.08, 0.03, 0.20), (0.58, 0.32, 0.90), (0.40, 0.10, 0.80)),
    "full-skirt": _skirt("full skirt", (0.10, 0.03, 0.25), (0.60, 0.32, 0.90), (1.20, 0.80, 2.00)),
    "pencil": _dress("narrow dress", (0.06, 0.03, 0.16), (0.94, 0.72, 1.10), (0.0, -0.04, 0.10)),
    "aline": _dress("A-line dress", (0.07, 0.03, 0.20), (0.95, 0.72, 1.25), (0.45, 0.10, 0.80)),
    "full": _dress("full dress", (0.07, 0.03, 0.20), (0.98, 0.72, 1.25), (1.20, 0.80, 2.00)),
    "strapless-dress": Kind(
        style="strapless-dress",
        summary="strapless dress held by elastic",
        ranges={
            "ease": _range(0.04, 0.035, 0.12),
            "length": _range(0.78, 0.56, 1.09),
            "flare": _range(0.45, 0.10, 1.20),
        },
        classes={"length": (0.69, 0.89, 1.09)},
        elastic=("top",),
    ),
}

DEFAULT_KINDS = {"top": "shirt", "bottom": "trousers", "dress": "aline"}
"""The garment that stands for each template where one of it is measured."""


def kind_of(name: str) -> Kind:
    """A kind by name.

    Raises:
        PhysXNetError: There is none.
    """
    if name not in KINDS:
        raise PhysXNetError(f"The tailor makes no '{name}'; there are {', '.join(KINDS)}.")
    return KINDS[name]
