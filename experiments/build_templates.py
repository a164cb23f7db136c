"""Cuts the three template garments from the body asset and stores them.

Command: python experiments/build_templates.py
Cost:    one minute.
Result:  src/physxnet_jax/garment/assets/templates_cc0.npz, the same bytes with the same
         library versions.
"""

import pathlib

import numpy as np

from physxnet_jax.garment import TEMPLATES, build_template, stored_arrays

OUT = pathlib.Path("src/physxnet_jax/garment/assets/templates_cc0.npz")


def main() -> None:
    arrays: dict[str, np.ndarray] = {}
    for name in TEMPLATES:
        arrays |= stored_arrays(build_template(name))
    OUT.parent.mkdir(parents=True, exist_ok=True)
    part = OUT.with_name("part.npz")
    np.savez_compressed(part, allow_pickle=False, **arrays)
    part.replace(OUT)
    print(f"{OUT}: {OUT.stat().st_size / 1e6:.2f} MB")  # noqa: T201


if __name__ == "__main__":
    main()
