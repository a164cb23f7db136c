"""Draws docs/pipeline.png, docs/demo.png and docs/walk.gif: maps in, maps out, mesh dressed.

Command: python experiments/draw_pipeline.py
Cost:    one minute.
Result:  one frame of the built-in punch: velocity, acceleration, gravity and offset maps
         beside the dressed body; six moments of the built-in walk, and the walk moving.
"""

import pathlib

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np

import physxnet_jax as px
from physxnet_jax.dressing import dress
from physxnet_jax.models import clip_features
from physxnet_jax.motion import clip_transforms, load_motion
from physxnet_jax.viewer import magnified, render_frame, render_preview, texel_picture

FRAME = 9
SIZE = 288


def main() -> None:
    body = px.load_body()
    rest = body.rest_vertices(body.default_shape())
    predictor = px.load_predictor()
    atlas = predictor.atlas
    motion = load_motion("punch", fps=30.0)
    seen = predictor.config.inputs
    world, shift = (
        jnp.asarray(x[FRAME + 1 - seen.window : FRAME + 1])
        for x in clip_transforms(body, rest, motion)
    )
    surface = predictor.texel_points
    features = clip_features(surface.rest, surface.weights, world, shift, 30.0, seen)
    inputs = np.asarray(features)[0]
    outputs = predictor(world, shift, 30.0, predictor.config.templates)
    texels = np.asarray(atlas.texels)
    shown = [inputs[:, 6:9], inputs[:, 15:18], inputs[:, 18:21]]
    shown += [np.asarray(outputs[t][0]) for t in predictor.config.templates]
    drawn = [texel_picture(x, texels, atlas.height, atlas.width) for x in shown]
    pictures = [magnified(x, SIZE) for x in drawn]
    maps = np.concatenate([np.concatenate(pictures[:3], 1), np.concatenate(pictures[3:], 1)])
    clip = dress(motion, ["top", "bottom"], frames=FRAME + 1)
    mesh = render_frame(clip.meshes, FRAME, size=(512, 2 * SIZE))
    pathlib.Path("docs").mkdir(exist_ok=True)
    iio.imwrite("docs/pipeline.png", np.concatenate([maps, mesh], axis=1))
    walk = dress("walk", ["top", "bottom"], frames=48)
    render_preview("docs/demo.png", walk.meshes, walk.fps, size=(240, 416))
    walk = dress("walk", ["top", "bottom"], frames=60)
    render_preview("docs/walk.gif", walk.meshes, walk.fps, size=(240, 320))


if __name__ == "__main__":
    main()
