"""The documents tell the truth: code runs, tables are the measured ones."""

import json
import math
import pathlib
import re
import runpy
import shlex
import tomllib

import pytest

from physxnet_jax.cli import parse
from physxnet_jax.cli._configs import read_config
from physxnet_jax.data import DatasetConfig, read_protocol
from physxnet_jax.dressing import dress, load_scene
from physxnet_jax.dressing._scene_file import SCENE_KEYS
from physxnet_jax.evaluation import CASES, ActionError, means
from physxnet_jax.garment import KINDS, TEMPLATES
from physxnet_jax.models import list_weights, read_card
from physxnet_jax.motion import read_joint_map
from physxnet_jax.simulation import EFFECTS
from physxnet_jax.simulation.effects import Air
from physxnet_jax.training import TrainConfig

ROOT = pathlib.Path(__file__).parents[1]
TEXT = (ROOT / "docs/simulation.md").read_text()
# Whether cloth looks like cloth.
LOOKS = ("fold_strength", "spectrum", "visible_skin", "tension_p99", "tension_p99_reference")


@pytest.mark.release
def test_simulation_page_code_runs_and_its_scene_file_loads(tmp_path):
    there = {}
    exec(re.search(r"```python\n(.*?)```", TEXT, re.S).group(1), there)
    assert any(isinstance(e, Air) for e in there["scene"].effects)
    path = tmp_path / "scene.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", TEXT, re.S).group(1))
    job = load_scene(path)
    assert job.motion.num_frames == 60
    assert job.scene.garments[0].fabric.density == 0.07


PAGES = [
    ROOT / "README.md",
    *(p for p in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in p.parts),
]


@pytest.mark.parametrize("path", PAGES, ids=lambda p: p.stem)
def test_every_documented_command_parses(path, monkeypatch):
    """Each line that begins with the command's name means something to it."""
    text = path.read_text()
    lines = re.findall(r"^(?:\.venv/bin/)?physxnet (.*?)(?: +#.*)?$", text, re.M)
    for line in lines:
        parse(shlex.split(line))


def test_each_row_of_the_pains_page_has_a_valid_command():
    rows = (ROOT / "docs/pains.md").read_text().partition("|---|---|---|\n")[2].splitlines()
    assert len(rows) == 24
    for row in rows:
        command = row.rstrip(" |").rpartition("| ")[2]
        assert command.startswith("`physxnet ") and command.endswith("`"), row
        parse(shlex.split(command.strip("`"))[1:])


def test_every_relative_link_exists():
    for path in PAGES:
        for link in re.findall(r"\]\((?!https?:|#)([^)#]+)", path.read_text()):
            assert (path.parent / link).exists(), f"{path.name}: {link}"


def test_reference_pages_are_those_that_the_program_makes():
    made = runpy.run_path(str(ROOT / "docs/generate.py"))
    pages = made["pages"]()
    assert {p.name for p in (ROOT / "docs/reference").iterdir()} == set(pages)
    for name, text in pages.items():
        assert (ROOT / "docs/reference" / name).read_text() == text, (
            f"python docs/generate.py: {name}"
        )
    # Every option and every setting is described.
    blank = [
        row
        for name in ("cli.md", "scene-files.md")
        for row in pages[name].splitlines()
        if re.match(r"\| `(--)?[\w-]+` \|", row) and row.endswith("|  |")
    ]
    assert not blank


@pytest.mark.release
def test_the_scene_schema_fits_the_program(tmp_path):
    """What the schema names is read, and what it doesn't is refused."""
    schema = json.loads((ROOT / "docs/reference/scene.schema.json").read_text())
    effects = schema["properties"]["effects"]["properties"]
    lines = ['motion = "walk"', "frames = 2", "standard = false"]
    for name, entry in effects.items():
        lines.append(f"[effects.{name}]")
        for key, field in entry["properties"].items():
            if field.get("default") not in (None, []):
                lines.append(f"{key} = {json.dumps(field['default'])}")
    path = tmp_path / "scene.toml"
    path.write_text("\n".join(lines))
    assert {type(e) for e in load_scene(path).scene.effects} == set(EFFECTS.values())
    text = (ROOT / "docs/reference/scene-files.md").read_text()
    path.write_text(re.search(r"```toml\n(.*?)```", text, re.S).group(1))
    assert load_scene(path).scene.garments[0].fabric.density == 0.4
    assert set(schema["properties"]) == set(SCENE_KEYS)


def test_documented_joint_map_is_valid(tmp_path):
    text = (ROOT / "docs/motion.md").read_text()
    path = tmp_path / "names.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", text, re.S).group(1))
    joints = read_joint_map(path)
    assert len(joints) == 13 and all(f"`{b}`" in text or f"{b} =" in text for b in joints)


def test_protocol_page_matches_the_measured_protocol(data_dir):
    text = (ROOT / "docs/protocol.md").read_text()
    rows = [[c.strip() for c in r.split("|")[1:-1]] for r in text.splitlines() if "| " in r]
    told = [
        (r[0], r[1], float(r[4]), float(r[5]), int(r[6]))
        for r in rows
        if r[0] in ("train", "test", "extra")
    ]
    assert told == [
        (a.split, a.name, a.fps, a.start, a.frames) for a in read_protocol(data_dir / "mocap")
    ]


def test_every_effect_is_listed():
    assert all(f"`{name}`" in TEXT for name in EFFECTS)


def test_simulation_page_holds_the_measured_tables():
    for name in (
        "convergence",
        "sim_bench",
        "visible_skin",
        "part_times",
        "batch_scaling",
        "cuda",
        "textile",
    ):
        block = re.search(rf"<!-- begin {name} -->\n(.*?)<!-- end {name} -->", TEXT, re.S)
        assert block and block.group(1) == (ROOT / f"experiments/results/{name}.md").read_text()


def test_networks_page_holds_the_measured_tables():
    text = (ROOT / "docs/networks.md").read_text()
    for name in ("losses", "guided"):
        block = re.search(rf"<!-- begin {name} -->\n(.*?)<!-- end {name} -->", text, re.S)
        measured = (ROOT / f"experiments/results/{name}.md").read_text()
        assert block and block.group(1).strip() == measured.strip()


def test_simulation_page_tables_match_the_measurements():
    measured = (ROOT / "experiments/results/sim_bench.md").read_text()
    solvers = ("| xpbd", "| bdf2", "| backward", "| verlet", "| blender", "| newton")
    rows = [r for r in TEXT.splitlines() if r.startswith(solvers)]
    assert len(rows) > 20 and all(r in measured for r in rows)
    penetration = (ROOT / "experiments/results/penetration.md").read_text()
    part = TEXT.partition("## Penetration")[2].splitlines()
    rows = [r for r in part if r.startswith(tuple(f"| {t} |" for t in TEMPLATES))]
    assert len(rows) == len(TEMPLATES) and all(r in penetration for r in rows)


def test_cost_tables_match_the_measurements():
    text = (ROOT / "docs/accuracy-cost.md").read_text()
    own = (ROOT / "docs/own-body.md").read_text()
    assert (ROOT / "experiments/results/own_bodies.md").read_text() in own
    for name in ("foreign_character", "foreign_rig"):
        assert (ROOT / f"experiments/results/{name}.md").read_text() in own
    for name in (
        "accuracy_cost",
        "peers",
        "engines",
        "training",
    ):
        block = re.search(rf"<!-- begin {name} -->\n(.*?)<!-- end {name} -->", text, re.S)
        assert block and block.group(1) == (ROOT / f"experiments/results/{name}.md").read_text()
    rows = json.loads((ROOT / "experiments/results/accuracy_cost.json").read_text())["rows"]
    named = {r["size"] for r in rows if r["method"].startswith(("network", "guided"))}
    commands = (ROOT / "experiments/accuracy_cost.sh").read_text()
    asked = re.findall(r"--weights (.*?) --garments", commands)
    assert named == {name for names in asked for name in names.split()}
    assert {n.partition("+")[0] for n in named} <= set(list_weights())


@pytest.mark.release
def test_round_trip_errors_match_the_documented_table():
    """Written and read back here, with fewer frames; the table is the measured one."""
    told = (ROOT / "experiments/results/round_trips.md").read_text()
    assert told in (ROOT / "docs/garments.md").read_text()
    made = runpy.run_path(str(ROOT / "experiments/round_trips.py"))
    meshes = list(dress("walk", ["bottom"], method="lbs", frames=2).meshes)
    for text in (told, made["table"](meshes)):
        far = [float(x) for x in re.findall(r"\| (\d\.\de[-+]\d+) \|", text)]
        assert len(far) == len(made["FORMATS"]) and max(far) < 1e-5


def test_blender_import_table_matches_the_measurements():
    text = (ROOT / "docs/garments.md").read_text()
    block = re.search(
        r"<!-- begin blender_import -->\n(.*?)<!-- end blender_import -->", text, re.S
    )
    measured = (ROOT / "experiments/results/blender_import.md").read_text()
    assert block and block.group(1) == measured
    assert all(float(x) < 1e-5 for x in re.findall(r"\| (\d\.\de-\d+) \|", measured))


def test_hard_case_table_matches_the_measurements():
    text = (ROOT / "docs/stability.md").read_text()
    table = runpy.run_path(str(ROOT / "experiments/reproduce.py"))["stress_table"]()
    assert f"<!-- begin stress -->\n{table}\n<!-- end stress -->" in text
    rows = json.loads((ROOT / "experiments/results/stress.json").read_text())
    assert {r["case"] for r in rows} == set(CASES)
    assert all(r["holds"] and r["measured"] <= r["bound"] for r in rows)
    for path in re.findall(r"`(tests/[\w/.]+)`", text):
        assert (ROOT / path).is_file(), path


def test_layer_table_matches_the_measurements():
    measured = (ROOT / "experiments/results/layers.md").read_text()
    assert measured in (ROOT / "docs/garments.md").read_text()
    for row in measured.splitlines()[2:]:
        outer, inner, *kept, own_outer, own_inner = (float(x) for x in row.split("|")[3:9])
        assert kept[0] < 0.2 * outer and kept[1] < 0.2 * inner
        # As README says.
        assert max(kept) < 4.0 and own_outer < 1.0 and own_inner < 0.5


def test_broken_file_table_matches_the_program():
    made = runpy.run_path(str(ROOT / "experiments/broken_files.py"))["table"]()
    assert made == (ROOT / "experiments/results/broken_files.md").read_text()
    assert made in (ROOT / "docs/broken-files.md").read_text()
    assert "(read)" not in made and made.count("\n") > 30


@pytest.mark.parametrize(
    ("page", "script"), [("reproduction", "everything"), ("accuracy-cost", "accuracy_cost")]
)
def test_script_contains_every_command_of_its_page(page, script):
    text = (ROOT / f"docs/{page}.md").read_text()
    block = re.findall(r"```\n(physxnet .*?)```", text, re.S)[0]
    script = (ROOT / f"experiments/{script}.sh").read_text()
    assert script.endswith(block) and "set -euo pipefail" in script
    for name in re.findall(r"^python (experiments/\w+\.py)", block, re.M):
        assert (ROOT / name).is_file()


def test_reproduction_page_matches_the_measurements():
    """Tables and claims are made of the rows, and the shipped cards say the same."""
    text = (ROOT / "docs/reproduction.md").read_text()
    told = json.loads((ROOT / "experiments/results/test_errors.json").read_text())
    rows = {"clothes": [ActionError(**r) for r in told]}
    assert all(math.isfinite(getattr(r, k)) for r in rows["clothes"] for k in LOOKS)
    told = json.loads((ROOT / "experiments/results/fitted_errors.json").read_text())
    rows["fitted"] = [ActionError(**r) for r in told]
    made = runpy.run_path(str(ROOT / "experiments/reproduce.py"))
    blocks = made["tables"]()
    named = re.findall(r"<!-- begin (\w+) -->", text)
    assert {"mse_clothes", "mse_fitted", "clothes", "claims", "datasets", "sizes"} <= set(named)
    for name in named:
        block = re.search(rf"<!-- begin {name} -->\n(.*?)<!-- end {name} -->", text, re.S)
        assert block and block.group(1).strip() == blocks[name].strip(), name
    assert named[0] == "mse_clothes" and len(text.split()) <= 4000
    for file, kind in (("datasets", DatasetConfig), ("training", TrainConfig)):
        path = ROOT / f"experiments/{file}.toml"
        named = set(re.findall(rf"experiments/{file}\.toml#([\w-]+)", text))
        tables = tomllib.loads(path.read_text())
        assert named and named <= set(tables)
        assert all(isinstance(read_config(f"{path}#{n}", kind), kind) for n in tables)
    for name in list_weights():
        card = read_card(name)
        own = rows["clothes" if card["model"].get("conditions") else "fitted"]
        assert card["measured"]
        for line in card["measured"]:
            found = means(own, line["method"], line["template"], line["reference"])
            assert found is not None
            assert round(found["rmse_vertices_mm"], 2) == line["rmse_vertices_mm"]
        assert card["licence"] and card["acknowledgement"]


def test_maps_hold_what_the_page_says():
    rows = json.loads((ROOT / "experiments/results/oracle.json").read_text())
    made = runpy.run_path(str(ROOT / "experiments/oracle.py"))
    assert made["table"](rows) == (ROOT / "experiments/results/oracle.md").read_text()
    best = [r for r in rows if (r["map"], r["resolution"]) == ("body+skirt", 128)]
    assert len(best) == 42 and all(r["rmse_mm"] < 2.0 for r in best)
    over = {(r["kind"], r["action"]) for r in best if r["wrinkle_deg"] > 9.0}
    assert over == {("shirt", "ballet")}


def test_scaling_tables_match_the_measurements():
    text = (ROOT / "docs/scale.md").read_text()
    for name in ("scaling", "scale"):
        part = text.partition(f"<!-- begin {name} -->\n")[2].partition(f"<!-- end {name} -->")[0]
        assert part == (ROOT / f"experiments/results/{name}.md").read_text()
    found = json.loads((ROOT / "experiments/results/scaling.json").read_text())
    made = runpy.run_path(str(ROOT / "experiments/scaling.py"))
    assert made["tables"](found) == (ROOT / "experiments/results/scaling.md").read_text()
    assert made["cost_table"](found) == (ROOT / "experiments/results/scale.md").read_text()
    # As the page says.
    assert all(r["share"] < 0.05 for r in found["pipeline"])
    pairs = [r for r in found["rows"] if r["processes"] == 2 and "64 x 64" not in r["what"]]
    assert len(pairs) == 3 and all(r["efficiency"] > 0.85 and r["same_result"] for r in pairs)


def test_wardrobe_table_matches_the_measurements():
    text = (ROOT / "docs/garments.md").read_text()
    part = text.partition("<!-- begin wardrobe -->\n")[2].partition("<!-- end wardrobe -->")[0]
    assert part == (ROOT / "experiments/results/wardrobe.md").read_text()
    rows = json.loads((ROOT / "experiments/results/wardrobe.json").read_text())
    outfits = runpy.run_path(str(ROOT / "experiments/wardrobe.py"))["OUTFITS"]
    assert {r["kind"] for r in rows} == {*KINDS, *outfits}


def test_kinds_of_the_tailor_are_those_of_the_page():
    text = (ROOT / "docs/garments.md").read_text()
    part = text.partition("<!-- begin tailor -->\n")[2].partition("<!-- end tailor -->")[0]
    assert part == runpy.run_path(str(ROOT / "experiments/build_tailor.py"))["kinds_table"]()
