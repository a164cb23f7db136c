"""Runs in a Python with Newton: cloth on a moving body, frame by frame.

Not imported by the package: `simulate_newton` starts it in a separate process.
Argument: a folder with ``scene.npz`` and ``settings.json``; writes ``cloth.npz`` there.
"""

import json
import pathlib
import sys
import time

import numpy as np


def main():
    """Builds the model, moves skin and pins in each substep and writes the cloth positions."""
    import newton  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    folder = pathlib.Path(sys.argv[-1])
    data = np.load(folder / "scene.npz")
    settings = json.loads((folder / "settings.json").read_text())
    skin, cloth = data["skin"], data["cloth"]
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -9.81, 0.0))
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*map(float, v)) for v in data["cloth_rest"]],
        indices=data["cloth_faces"].reshape(-1).tolist(),
        density=settings["density"],
        tri_ke=settings["stretch"],
        tri_ka=settings["stretch"],
        tri_kd=settings["damping"],
        edge_ke=settings["bend"],
        edge_kd=settings["damping"],
        particle_radius=settings["radius"],
    )
    pinned = np.flatnonzero(data["pinned"])
    for v in pinned:
        builder.particle_mass[v] = 0.0
        builder.particle_flags[v] = builder.particle_flags[v] & ~int(newton.ParticleFlags.ACTIVE)
    body = newton.Mesh(skin[0], data["skin_faces"].reshape(-1).astype(np.int32))
    shape = newton.ModelBuilder.ShapeConfig(mu=settings["friction"])
    builder.add_shape_mesh(body=-1, mesh=body, cfg=shape)
    builder.color()
    model = builder.finalize()
    model.soft_contact_ke = settings["contact"]
    model.soft_contact_kd = 1e-3
    model.soft_contact_mu = settings["friction"]
    solver = newton.solvers.SolverVBD(
        model,
        iterations=settings["iterations"],
        particle_enable_self_contact=settings["self_collision"],
    )
    pipeline = newton.CollisionPipeline(
        model, soft_contact_gap=0.03, soft_contact_max=settings["contacts"] * cloth.shape[1]
    )
    contacts = pipeline.contacts()
    mesh = body.mesh
    first, second, control = model.state(), model.state(), model.control()
    first.particle_q.assign(cloth[0])
    second.particle_q.assign(cloth[0])
    n, fps = settings["substeps"], float(data["fps"])
    h = 1.0 / fps / n
    rows = wp.array(pinned, dtype=int)

    @wp.kernel
    def pin(q: wp.array(dtype=wp.vec3), index: wp.array(dtype=int), at: wp.array(dtype=wp.vec3)):
        """Sets the pinned vertices to their prescribed positions."""
        k = wp.tid()
        q[index[k]] = at[k]

    out = np.zeros_like(cloth)
    out[0] = cloth[0]
    frame_times = np.zeros(len(cloth))
    for f in range(1, len(cloth)):
        start = time.perf_counter()
        velocity = (skin[f] - skin[f - 1]) * fps
        mesh.velocities.assign(velocity)
        for k in range(1, n + 1):
            share = k / n
            mesh.points.assign((1.0 - share) * skin[f - 1] + share * skin[f])
            mesh.refit()
            if len(pinned):
                at = (1.0 - share) * cloth[f - 1, pinned] + share * cloth[f, pinned]
                for state in (first, second):
                    wp.launch(
                        pin, len(pinned), [state.particle_q, rows, wp.array(at, dtype=wp.vec3)]
                    )
            first.clear_forces()
            pipeline.collide(first, contacts)
            solver.step(first, second, control, contacts, h)
            first, second = second, first
        out[f] = first.particle_q.numpy()
        frame_times[f] = 1e3 * (time.perf_counter() - start)
        print(f"frame {f + 1}", flush=True)  # noqa: T201
    np.savez(folder / "cloth.npz", positions=out, milliseconds=frame_times)


if __name__ == "__main__":
    main()
