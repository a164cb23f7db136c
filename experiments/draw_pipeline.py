"""Draws docs/pipeline.png: maps in, maps out, mesh dressed.

Command: python experiments/draw_pipeline.py
Cost:    two minutes.
Result:  one frame of the built-in punch: velocity, acceleration, gravity and offset maps
         beside the dressed body.
"""

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np

import physxnet_jax as px
from physxnet_jax.dressing import dress
from physxnet_jax.garment import DEFAULT_KINDS, tailor
from physxnet_jax.models import clip_features
from physxnet_jax.motion import clip_transforms, load_motion
from physxnet_jax.viewer import magnified, render_frame, texel_picture

FRAME = 31
SIZE = 288


def main() -> None:
    motion = load_motion("punch", fps=30.0)
    dresser = px.make_dresser([tailor(k) for k in DEFAULT_KINDS.values()])
    predictor = dresser.predictor
    assert predictor is not None
    seen = predictor.config.inputs
    world, shift = (
        jnp.asarray(x[FRAME + 1 - seen.window : FRAME + 1])
        for x in clip_transforms(dresser.body, dresser.rest, motion)
    )
    points = predictor.texel_points
    features = clip_features(points.rest, points.weights, world, shift, 30.0, seen)
    inputs = np.asarray(features)[0]
    known = {w.template: w.modulation for w in dresser.worn}  # pyright: ignore
    outputs = predictor(world, shift, 30.0, predictor.config.templates, known)
    # The newest velocity, the newest acceleration, gravity.
    n = 3 * seen.frames
    shown = [inputs[:, n - 3 : n], inputs[:, 2 * n - 3 : 2 * n], inputs[:, 2 * n : 2 * n + 3]]
    atlases = 3 * [predictor.motion_atlas] + 3 * [predictor.atlas]
    shown += [np.asarray(outputs[t][0]) for t in predictor.config.templates]
    drawn = [
        texel_picture(x, np.asarray(a.texels), a.height, a.width)
        for x, a in zip(shown, atlases, strict=True)
    ]
    pictures = [magnified(x, SIZE) for x in drawn]
    maps = np.concatenate([np.concatenate(pictures[:3], 1), np.concatenate(pictures[3:], 1)])
    clip = dress(motion, ["shirt", "trousers"], frames=FRAME + 1)
    mesh = render_frame(clip.meshes, FRAME, size=(512, maps.shape[0] // 16 * 16))
    high = min(len(maps), len(mesh))
    iio.imwrite("docs/pipeline.png", np.concatenate([maps[:high], mesh[:high]], axis=1))


if __name__ == "__main__":
    main()
