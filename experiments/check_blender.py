"""Opens a USD in Blender and compares every vertex of every frame with the npz.

Command: physxnet dress walk --frames 20 -o out/a.usdc
         physxnet dress walk --frames 20 -o out/a.npz
         BPY_PYTHON experiments/check_blender.py out/a.usdc out/a.npz
         where BPY_PYTHON is a Python with `bpy` installed, in an environment of its own.
Cost:    half a minute.
Result:  the largest difference in metres for each mesh; under 1e-5.
"""

import sys

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np


def main() -> None:
    stage, archive = sys.argv[1:3]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=stage)
    worst = 0.0
    with np.load(archive) as data:
        names = [k.removesuffix("_positions") for k in data.files if k.endswith("_positions")]
        for name in names:
            expected = data[f"{name}_positions"]
            gap = 0.0
            for frame in range(len(expected)):
                bpy.context.scene.frame_set(frame)
                graph = bpy.context.evaluated_depsgraph_get()
                thing = bpy.data.objects[name].evaluated_get(graph)
                points = np.empty(3 * len(thing.data.vertices), np.float32)
                thing.data.vertices.foreach_get("co", points)
                turn = np.asarray(thing.matrix_world)
                world = points.reshape(-1, 3) @ turn[:3, :3].T + turn[:3, 3]
                # Blender is Z up: its (x, y, z) is our (x, -z, y).
                ours = np.column_stack([world[:, 0], world[:, 2], -world[:, 1]])
                gap = max(gap, float(np.abs(ours - expected[frame]).max()))
            print(f"{name}: {expected.shape[0]} frames, largest difference {gap:.2e} m")  # noqa: T201
            worst = max(worst, gap)
    sys.exit(worst > 1e-5)


if __name__ == "__main__":
    main()
