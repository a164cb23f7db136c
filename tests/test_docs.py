"""docs/simulation.md tells the truth: its code runs, its tables are the measured ones."""

import pathlib
import re

from physxnet_jax.dressing import load_scene
from physxnet_jax.garment import FABRICS, TEMPLATES
from physxnet_jax.simulation import EFFECTS, Air

ROOT = pathlib.Path(__file__).parents[1]
TEXT = (ROOT / "docs/simulation.md").read_text()


def test_the_code_runs_and_the_scene_file_loads(tmp_path):
    there = {}
    exec(re.search(r"```python\n(.*?)```", TEXT, re.S).group(1), there)
    assert any(isinstance(e, Air) for e in there["scene"].effects)
    path = tmp_path / "scene.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", TEXT, re.S).group(1))
    job = load_scene(path)
    assert job.motion.num_frames == 60
    assert job.scene.garments[0].fabric.density == 0.07


def test_every_effect_is_listed():
    assert all(f"`{name}`" in TEXT for name in EFFECTS)


def test_the_tables_are_the_measured_ones():
    measured = (ROOT / "experiments/results/sim_bench.md").read_text()
    solvers = ("| xpbd", "| bdf2", "| backward", "| verlet", "| blender", "| newton")
    rows = [r for r in TEXT.splitlines() if r.startswith(solvers)]
    assert len(rows) > 20 and all(r in measured for r in rows)
    penetration = (ROOT / "experiments/results/penetration.md").read_text()
    rows = [r for r in TEXT.splitlines() if r.startswith(tuple(f"| {t} |" for t in TEMPLATES))]
    assert len(rows) == len(TEMPLATES) and all(r in penetration for r in rows)
    textile = (ROOT / "experiments/results/textile.md").read_text()
    rows = [r for r in TEXT.splitlines() if r.startswith(tuple(f"| {f} |" for f in FABRICS))]
    assert len(rows) == len(FABRICS) and all(r in textile for r in rows)
