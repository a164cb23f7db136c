"""Every fabric on the instruments of a textile laboratory: Cusick's drapemeter, cantilever.

Command: python experiments/textile_tests.py
Cost:    about four minutes on two cores.
Result:  experiments/results/textile.json and .md: drape coefficient at two mesh sizes beside
         its published band, folds, and the bending length that a strip shows beside that
         of the fabric's own numbers; textile.png with the six specimens from above.
"""

import dataclasses
import json
import pathlib

import numpy as np
from rich.progress import track

from physxnet_jax.evaluation import DRAPE_BANDS, cantilever_test, drape_test
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import FABRICS

RESULTS = pathlib.Path(__file__).parent / "results"


def main() -> None:
    rows, specimens = [], {}
    for name in track(FABRICS, description="fabrics"):
        fabric = FABRICS[name]
        strip = cantilever_test(fabric)
        coarse, fine = drape_test(fabric), drape_test(fabric, edge=0.007)
        low, high, source = DRAPE_BANDS[name]
        specimens[name] = fine
        rows.append(
            {
                "fabric": name,
                "drape_percent": coarse.coefficient,
                "drape_fine_percent": fine.coefficient,
                "band": [low, high],
                "in_band": bool(low <= coarse.coefficient <= high),
                "source": source,
                "folds": [coarse.folds, fine.folds],
                "last_speed_m_s": fine.speed,
                **{f"cantilever_{k}": v for k, v in dataclasses.asdict(strip).items()},
            }
        )
    with atomic_write(RESULTS / "textile.json") as part:
        part.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    lines = [
        "| fabric | drape % (10 mm mesh) | (7 mm) | published | folds | (7 mm) |"
        " bending length mm | measured mm |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        low, high = r["band"]
        lines.append(
            f"| {r['fabric']} | {r['drape_percent']:.1f} | {r['drape_fine_percent']:.1f} |"
            f" {low:.0f} to {high:.0f} | {r['folds'][0]} | {r['folds'][1]} |"
            f" {1e3 * r['cantilever_length']:.1f} | {1e3 * r['cantilever_measured']:.1f} |"
        )
    with atomic_write(RESULTS / "textile.md") as part:
        part.write_text("\n".join(lines) + "\n")
    draw(specimens)


def draw(specimens: dict) -> None:
    """The six specimens from above and from the side."""
    import pyvista

    plot = pyvista.Plotter(off_screen=True, shape=(2, 3), window_size=[960, 560])
    for k, (name, drape) in enumerate(specimens.items()):
        plot.subplot(k // 3, k % 3)
        plot.set_background("white")
        mesh = pyvista.PolyData.from_regular_faces(drape.positions, drape.faces)
        plot.add_mesh(mesh, color=(0.16, 0.27, 0.55), smooth_shading=True)
        plot.add_text(f"{name}, {drape.coefficient:.0f} %", font_size=10, color="black")
        plot.camera_position = [(0.0, 0.55, 0.45), (0.0, -0.04, 0.0), (0.0, 1.0, 0.0)]
        plot.camera.view_angle = 32.0
    plot.render()
    picture = np.asarray(plot.screenshot(return_img=True))
    from PIL import Image

    with atomic_write(RESULTS / "textile.png") as part:
        Image.fromarray(picture).save(part, format="PNG")


if __name__ == "__main__":
    main()
