"""A picture of each limit that README.md lists.

Command: python experiments/limits.py, with the folder of motions in PHYSXNET_DATA
Cost:    three minutes on two cores.
Result:  docs/limits.jpg: the limits from left to right, in the list's order.
"""

import dataclasses
import os
import pathlib

import imageio.v2 as imageio
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw
from rich.progress import track

import physxnet_jax as px
from physxnet_jax.files import atomic_write
from physxnet_jax.viewer import render_frame

ROOT = pathlib.Path(__file__).parents[1]
OUT = ROOT / "docs/limits.jpg"
DATA = pathlib.Path(os.environ.get("PHYSXNET_DATA", ROOT.parent / "shared"))
# Pictures are drawn in this size, of which each panel shows a part [pixels].
DRAWN, PANEL = (768, 1024), (300, 400)


def panel(clip: px.DressedClip, frame: int, part: tuple[float, float, float]) -> Image.Image:
    """A part of a frame: its left and upper border, and its width, over the picture's."""
    shown = render_frame(clip.meshes, frame=frame, size=DRAWN, camera="front", background="studio")
    left, top, width = (DRAWN[0] * x for x in part)
    box = (left, top, left + width, top + width * PANEL[1] / PANEL[0])
    return Image.fromarray(shown).resize(PANEL, Image.Resampling.LANCZOS, box=box)


def halves(left: Image.Image, right: Image.Image) -> Image.Image:
    """Two pictures side by side, the middle of each."""
    out, half = Image.new("RGB", PANEL), PANEL[0] // 2
    for k, picture in enumerate((left, right)):
        out.paste(picture.crop((half // 2, 0, half // 2 + half, PANEL[1])), (k * half, 0))
    return out


def folds() -> Image.Image:
    """Guided on the left, simulated on the right."""
    clips = (px.dress("punch", ["aline"], method=m, frames=31) for m in ("guided", "simulate"))
    left, right = (panel(c, 30, (0.1, 0.2, 0.8)) for c in clips)
    return halves(left, right)


def layers() -> Image.Image:
    clip = px.dress("squat", ["trousers", "shirt"], method="network", frames=36)
    return panel(clip, 35, (0.3, 0.5, 0.4))


def armpit() -> Image.Image:
    clip = px.dress("walk", ["tee"], method="network", frames=16)
    return panel(clip, 15, (0.3, 0.25, 0.25))


def hem() -> Image.Image:
    kick = DATA / "mocap/amc/011_01.amc"
    clip = px.dress(kick, ["skirt:length=0.75"], method="network", frames=112)
    return panel(clip, 108, (0.3, 0.45, 0.5))


def noise() -> Image.Image:
    """A frame before a jerk of the hips by eight centimetres, and that frame."""
    motion = px.load_motion("walk", fps=30)
    root = jnp.asarray(motion.root).at[20, 0].add(0.08)
    clip = px.dress(dataclasses.replace(motion, root=root), ["aline"], frames=22)
    return halves(*(panel(clip, k, (0.1, 0.25, 0.8)) for k in (19, 20)))


def main() -> None:
    makers = (folds, layers, armpit, hem, noise)
    panels = [make() for make in track(makers, description="pictures")]
    out = Image.new("RGB", (PANEL[0] * len(panels), PANEL[1]), "white")
    for k, picture in enumerate(panels):
        ImageDraw.Draw(picture).text((8, 4), str(k + 1), fill="#202428", font_size=28)
        out.paste(picture.crop((0, 0, PANEL[0] - 4, PANEL[1])), (k * PANEL[0], 0))
    with atomic_write(OUT) as part, part.open("wb") as file:
        imageio.imwrite(file, np.asarray(out), format="jpg", quality=85)


if __name__ == "__main__":
    main()
