"""Draws the tailor's garments: every kind, one dress by ease and length, fabrics, outfits, methods.

Command: python experiments/garment_pictures.py [kinds] [measures] [fabrics] [outfit] [look]
         (all by default); salsa needs $PHYSXNET_DATA or ../shared, else its column shows spin
Cost:    half a minute a garment on two cores.
Result:  docs/garments.png (front and back, at rest and in three poses), docs/measures.png,
         docs/fabrics.png, docs/outfit.png, docs/look.png (by skinning, network, guided, simulated:
         shirt and trousers on a soft motion, a dress and a garment file on an abrupt one), and the
         first two in motion, front and back: docs/soft.mp4, docs/abrupt.mp4.
"""

import argparse
import dataclasses
import os
import pathlib

import jax
import numpy as np
from rich.progress import track

from physxnet_jax import Simulation, dress
from physxnet_jax.body import load_body
from physxnet_jax.garment import KINDS, Garment, load_garment, tailor
from physxnet_jax.motion import Motion, body_animation, load_motion
from physxnet_jax.simulation import Scene, prepare_scene, simulate_batch, standard_effects

DOCS = pathlib.Path("docs")
METHODS = ("lbs", "network", "guided", "simulate, reference")
VIDEOS = {"salsa": "soft.mp4", "punch": "abrupt.mp4"}
SKIN, COLOURS = "#d8b49c", ("#5f7fae", "#9a6b4f", "#6d8f6a")


def shared() -> pathlib.Path:
    return pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared"))


def clip(name: str, frames: int) -> Motion:
    word = name
    if name == "salsa":
        file = shared() / "mocap/daz/060_12.bvh"
        word = str(file) if file.is_file() else "spin"
    m = load_motion(word, fps=30.0)
    return dataclasses.replace(m, rotations=m.rotations[:frames], root=m.root[:frames])


def worn(garments: tuple[Garment, ...], motion: Motion) -> tuple[np.ndarray, ...]:
    scene = prepare_scene(Scene(garments, standard_effects(garments)))
    return simulate_batch(scene, [motion])[0].positions


def person(garments, positions, skin, faces, turn, size, close=False):
    """One view of a dressed person, or close up of the clothes; ``turn`` is where the camera is."""
    import pyvista as pv

    def surface(v, f):
        return pv.PolyData(np.asarray(v, float), np.column_stack([np.full(len(f), 3), f]).ravel())

    plotter = pv.Plotter(off_screen=True, window_size=list(size))
    plotter.set_background("white")
    plotter.add_mesh(surface(skin, faces), color=SKIN, smooth_shading=True)
    for k, (g, x) in enumerate(zip(garments, positions, strict=True)):
        cloth = surface(x, np.asarray(g.mesh.faces))
        cloth = cloth.compute_normals(split_vertices=False, auto_orient_normals=False)
        plotter.add_mesh(cloth, color=COLOURS[k % len(COLOURS)], smooth_shading=True)
    shown = np.concatenate(positions) if close else skin
    middle = 0.5 * (shown.min(axis=0) + shown.max(axis=0))
    plotter.camera.parallel_projection = True
    plotter.camera.focal_point = middle
    plotter.camera.position = middle + 3.0 * turn + np.array([0, 0.15, 0])
    plotter.camera.up = (0, 1, 0)
    plotter.camera.parallel_scale = 0.6 if close else 0.9
    image = np.asarray(plotter.screenshot(return_img=True))[..., :3]
    plotter.close()
    return image


def views(garments, motion, positions, frame, size, close=False):
    """Front and back of a frame, side by side."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    still = dataclasses.replace(
        motion, rotations=motion.rotations[frame : frame + 1], root=motion.root[frame : frame + 1]
    )
    skin = np.asarray(body_animation(body, still, None))[0]
    turns, _ = body.transforms(rest, motion.rotations[frame], motion.root[frame])
    ahead = np.asarray(turns[0]) @ np.array([0.0, 0.0, 1.0])
    ahead = ahead * [1, 0, 1] / np.linalg.norm(ahead * [1, 0, 1])
    faces = np.asarray(body.rest_mesh().faces)
    x = [p[frame] for p in positions]
    return np.hstack(
        [person(garments, x, skin, faces, s * ahead, size, close) for s in (1.0, -1.0)]
    )


def at_rest(garments, size):
    body = load_body()
    faces, skin = np.asarray(body.rest_mesh().faces), np.asarray(body.rest_mesh().vertices)
    x = [np.asarray(g.mesh.vertices) for g in garments]
    turns = (np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]))
    return np.hstack([person(garments, x, skin, faces, t, size) for t in turns])


def titled(image, text):
    from PIL import Image, ImageDraw, ImageFont

    bar = Image.new("RGB", (image.shape[1], 26), "white")
    font = ImageFont.load_default(18)
    ImageDraw.Draw(bar).text((6, 2), text, fill="#202428", font=font)
    return np.vstack([np.asarray(bar), image])


def save(name: str, image: np.ndarray) -> None:
    from PIL import Image

    # A palette keeps the sheets small.
    Image.fromarray(image).quantize(192).save(DOCS / name, optimize=True)
    print(f"{DOCS / name}: {(DOCS / name).stat().st_size / 1e6:.2f} MB")  # noqa: T201


def grid(images, columns):
    rows = [np.hstack(images[k : k + columns]) for k in range(0, len(images), columns)]
    width = max(r.shape[1] for r in rows)
    padded = [((0, 0), (0, width - r.shape[1]), (0, 0)) for r in rows]
    return np.vstack([np.pad(r, p, constant_values=255) for r, p in zip(rows, padded, strict=True)])


def kinds() -> None:
    """Every kind: at rest, two poses of the punch, one of the salsa."""
    size, out = (150, 285), []
    for name in track(KINDS, description="kinds"):
        g = (tailor(name),)
        parts = [at_rest(g, size)]
        for action, frames in (("punch", (25, 50)), ("salsa", (45,))):
            motion = clip(action, 60)
            x = worn(g, motion)
            parts += [views(g, motion, x, f, size) for f in frames]
        out.append(titled(np.vstack([np.hstack(parts[:2]), np.hstack(parts[2:])]), name))
        jax.clear_caches()
    save("garments.png", grid(out, 5))


def measures() -> None:
    """The A-line dress by ease and by length."""
    motion, out = clip("punch", 40), []
    for length in (0.75, 0.95, 1.2):
        for ease in (0.03, 0.1, 0.2):
            g = (tailor("aline", ease=ease, length=length),)
            image = views(g, motion, worn(g, motion), 35, (200, 380))
            out.append(titled(image, f"ease {ease:g} m, length {length:g} m"))
    save("measures.png", grid(out, 3))


def fabrics() -> None:
    """Silk, denim and jersey on one A-line dress."""
    motion, out = clip("spin", 90), []
    for name in ("silk", "denim", "jersey"):
        g = (tailor("aline", flare=0.8, fabric=name),)
        x = worn(g, motion)
        parts = [views(g, motion, x, f, (340, 460), close=True) for f in (60, 85)]
        out.append(titled(np.vstack(parts), name))
    save("fabrics.png", grid(out, 3))


def outfit() -> None:
    """Shirt over trousers and T-shirt over a skirt, on three motions."""
    out = []
    for words in (("trousers", "shirt"), ("skirt", "tee")):
        g = tuple(tailor(w) for w in words)
        for action, frame in (("punch", 50), ("salsa", 50), ("squat", 35)):
            motion = clip(action, 60)
            image = views(g, motion, worn(g, motion), frame, (300, 560))
            out.append(titled(image, f"{' + '.join(words)}, {action}"))
    save("outfit.png", grid(out, 3))


def cloth_by(method: str, garments, motion: Motion) -> tuple[np.ndarray, ...]:
    """Garments in every frame, by a method of `METHODS`."""
    kind, _, accuracy = method.partition(", ")
    simulation = Simulation(accuracy=accuracy) if accuracy else None
    made = dress(motion, garments, method=kind, simulation=simulation, include_body=False)
    jax.clear_caches()
    return tuple(np.asarray(m.positions) for m in made.meshes)


def scenes():
    """A soft action, an abrupt one, and a garment file where there is one."""
    yield "salsa", (tailor("trousers"), tailor("shirt")), clip("salsa", 60), (20, 59)
    yield "punch", (tailor("aline"),), clip("punch", 60), (15, 45)
    file = shared() / "garments/longsleeve.obj"
    if file.is_file():
        yield "longsleeve.obj", (load_garment(file)[0],), clip("punch", 60), (15, 45)


def look() -> None:
    """Default garments and a file on a soft and an abrupt motion, by every method."""
    rows = {method: [] for method in METHODS}
    for name, garments, motion, frames in scenes():
        clips = []
        for method in METHODS:
            x = cloth_by(method, garments, motion)
            parts = [views(garments, motion, x, f, (200, 380)) for f in frames]
            rows[method].append(np.hstack(parts))
            clips.append([views(garments, motion, x, f, (320, 608)) for f in range(60)])
        if name in VIDEOS:
            titles = [titled(clip[0], m)[:26] for clip, m in zip(clips, METHODS, strict=True)]
            pictures = [np.vstack([np.hstack(titles), np.hstack(each)]) for each in zip(*clips)]
            video(VIDEOS[name], pictures)
    save("look.png", np.vstack([titled(np.hstack(r), m) for m, r in rows.items()]))


def video(name: str, pictures: list[np.ndarray]) -> None:
    import imageio.v2 as imageio

    with imageio.get_writer(DOCS / name, fps=30, quality=7, macro_block_size=2) as writer:
        for picture in pictures:
            height, width = (n - n % 2 for n in picture.shape[:2])
            writer.append_data(picture[:height, :width])
    print(f"{DOCS / name}: {(DOCS / name).stat().st_size / 1e6:.2f} MB")  # noqa: T201


def main() -> None:
    sheets = {
        "kinds": kinds,
        "measures": measures,
        "fabrics": fabrics,
        "outfit": outfit,
        "look": look,
    }
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sheets", nargs="*", default=[])
    for name in parser.parse_args().sheets or sheets:
        sheets[name]()


if __name__ == "__main__":
    main()
