"""Twelve pictures of dressed people, each with the command that makes it.

Command: python experiments/gallery.py, with the folder of motions and garments in PHYSXNET_DATA
Cost:    ten minutes on two cores; goes on where it was stopped.
Result:  docs/gallery/*.jpg, docs/gallery.md and the moving pictures of README.md.
"""

import os
import pathlib
import runpy
import shlex
import sys
import tempfile

import imageio.v2 as imageio

import physxnet_jax as px
from physxnet_jax.cli import main as physxnet
from physxnet_jax.files import atomic_write

ROOT = pathlib.Path(__file__).parents[1]
FOLDER = ROOT / "docs/gallery"
DATA = pathlib.Path(os.environ.get("PHYSXNET_DATA", ROOT.parent / "shared"))
_SIZE = "--size 480 544"
_OWN = "DATA/garments"
# Name, title, options. DATA stands for the folder of motions and garments.
PICTURES = (
    (
        "guided",
        "a shirt and trousers, guided (the default)",
        "walk --wear shirt trousers --start 1",
    ),
    ("aline", "an A-line dress on *punch*, guided", "punch --wear aline --start 0.6"),
    ("simulated", "the same dress, simulated", "punch --wear aline --start 0.6 --method simulate"),
    ("wind", "a skirt of silk in wind", "balance --wear skirt:fabric=silk tee --wind 0 0 5"),
    ("outfit", "three layers: trousers, dress, shirt", "walk --wear trousers aline shirt"),
    (
        *("denim", "wide trousers of denim on *jogging*"),
        "DATA/mocap/amc/002_03.amc --wear wide:fabric=denim tee",
    ),
    ("kick", "a tee and shorts on *kick ball*", "DATA/mocap/amc/011_01.amc --wear tee shorts"),
    ("long", "a dress from a file", f"walk --wear {_OWN}/F_Dress_01.obj"),
    ("tank", "a top and pants from files", f"punch --wear {_OWN}/pants.obj {_OWN}/Tank_Top_01.obj"),
    (
        *("tights", "a skirt over tights from files, simulated"),
        f"walk --wear {_OWN}/helper_tights.obj {_OWN}/helper_skirt.obj --method simulate",
    ),
    (
        *("sleeves", "long sleeves from a file"),
        f"walk --wear {_OWN}/longsleeve.obj trousers --start 0.5",
    ),
    (
        *("shape", "the same clothes on another body"),
        "walk --wear shirt trousers --shape weight_up=0.8 height_up=0.4",
    ),
)
# Of README.md: name and options.
MOVING = (
    ("network", "walk --wear aline --method network --start 0.5"),
    ("guided", "punch --wear shirt trousers --start 0.4"),
    ("avatar", "walk --character AVATAR --wear tee skirt --start 0.5"),
)


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, _, words in PICTURES:
        path = FOLDER / f"{name}.jpg"
        if path.is_file():
            continue
        with tempfile.TemporaryDirectory() as folder:
            shot = pathlib.Path(folder) / "shot.png"
            given = shlex.split(f"{words.replace('DATA', str(DATA))} --frames 24 {_SIZE}")
            if physxnet(["dress", *given, "--preview", str(shot), "--quiet"]):
                raise SystemExit(f"{name}: not dressed")
            with atomic_write(path) as part, part.open("wb") as file:
                imageio.imwrite(file, imageio.imread(shot), format="jpg", quality=88)
        sys.stdout.write(f"{name}\n")
    move()
    with atomic_write(ROOT / "docs/gallery.md") as part:
        part.write_text(page())


def move() -> None:
    """The moving pictures of README.md; the avatar is a rig of other proportions."""
    samples = runpy.run_path(str(ROOT / "tests/samples.py"))
    body = px.load_body()
    for name, words in MOVING:
        path = ROOT / f"docs/{name}.gif"
        if path.is_file():
            continue
        with tempfile.TemporaryDirectory() as folder:
            avatar = pathlib.Path(folder) / "avatar.vrm"
            child = body.shape(height_down=0.9, weight_up=0.4)
            samples["rigged_person"](avatar, body, child)
            given = shlex.split(f"{words.replace('AVATAR', str(avatar))} --frames 44")
            look = ["--size", "256", "304", "--background", "white", "--preview", str(path)]
            if physxnet(["dress", *given, *look, "--quiet"]):
                raise SystemExit(f"{name}: not dressed")
        sys.stdout.write(f"{name}.gif\n")


def page() -> str:
    """The page of the gallery."""
    lines = [
        "# Gallery",
        "",
        "Each picture is the middle of 24 frames, made by the command below it (`python",
        "experiments/gallery.py` makes all). DATA is a folder of motions and garments of your own.",
        "",
    ]
    for name, title, words in PICTURES:
        lines += [
            f"## {title[0].upper()}{title[1:]}",
            "",
            f"![{title.replace('*', '')}](gallery/{name}.jpg)",
            "",
            "```",
            f"physxnet dress {words} --frames 24 --preview {name}.png",
            "```",
            "",
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
