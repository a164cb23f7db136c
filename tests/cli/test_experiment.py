"""From a configuration to a table of errors, through the command line, at toy size."""

import importlib.util
import json
import shutil

import pytest

from physxnet_jax.cli import main
from physxnet_jax.data import dataset_digest, list_sequences, read_times
from physxnet_jax.dressing import EXPORTED
from physxnet_jax.motion import load_motion, save_motion

DATASET = """
[small]
splits = ["train"]
templates = ["bottom"]
solver = { substeps = 8, contact_updates = 1 }

[set]
base = "small"
exaggerate = 1.1
"""
TRAIN = """
model = { resolution = 32, width = 4, templates = ["bottom"] }
epochs = 2
batch = 4
adversarial = false
"""


def check_on_ray(measure, rows, folder):
    """Jobs on Ray give the same rows in the same order, apart from their times."""
    if importlib.util.find_spec("ray") is None:
        return
    out = folder / "on_ray.json"
    for _ in range(2):
        assert main([*measure[:-1], str(out), "--ray", "--quiet"]) == 0
        same = json.loads(out.read_text())
        for a, b in zip(same, rows, strict=True):
            assert a.keys() == b.keys()
            for key in a.keys() - {"ms_per_frame"}:
                word = isinstance(b[key], str)
                assert a[key] == (b[key] if word else pytest.approx(b[key], rel=1e-3)), key


@pytest.mark.release
def test_stress_on_ray(capsys):
    pytest.importorskip("ray", reason="Ray isn't installed: physxnet-jax[cluster]")
    shown = []
    for extra in ([], ["--ray"]):
        assert main(["stress", "--cases", "hanging_strip", "free_fall", "--json", *extra]) == 0
        shown.append(json.loads(capsys.readouterr().out))
    plain, on_ray = shown
    assert [r["case"] for r in on_ray] == [r["case"] for r in plain]
    for a, b in zip(on_ray, plain, strict=True):
        assert a["quantity"] == b["quantity"] and a["holds"] == b["holds"]
        assert a["measured"] == pytest.approx(b["measured"], rel=0.05, abs=1e-5)


@pytest.mark.release
def test_build_train_evaluate(tmp_path, capsys):
    mocap = str(tmp_path / "mocap")
    save_motion(tmp_path / "mocap/a.npz", load_motion("punch", fps=30))
    (tmp_path / "mocap/ACTIONS.csv").write_text(
        "split,action,file,start_s,frames_at_30fps\ntrain,run,a.npz,0.0,34\ntest,on,a.npz,2,30\n"
    )
    for name, text in (("dataset.toml", DATASET), ("tiny.toml", TRAIN)):
        (tmp_path / name).write_text(text)
    root, run, out = (str(tmp_path / n) for n in ("set", "run", "errors.json"))
    build = [
        "dataset",
        "build",
        f"{tmp_path / 'dataset.toml'}#set",
        "--out",
        root,
        "--mocap",
        mocap,
    ]
    assert main([*build, "--only", "run", "--json"]) == 0
    assert len(list_sequences(root)) == 1 and len(read_times(root)) == 1
    shown = json.loads(capsys.readouterr().out)
    assert shown["simulated"] == 1 and (shown["sha256"], shown["bytes"]) == dataset_digest(root)
    sheet = tmp_path / "sheet.png"
    check = ["dataset", "check", root, "--mocap", mocap, "--json", "--contact-sheet", str(sheet)]
    capsys.readouterr()
    assert main(check) in (0, 1)
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert {r["quantity"] for r in rows} >= {"frames missing", "slid along the body, m"}
    assert sheet.stat().st_size > 1000
    train = ["train", str(tmp_path / "tiny.toml"), "--data", root, "--out", run, "--steps", "2"]
    assert main([*train, "--quiet"]) == 0
    card = json.loads((tmp_path / "run/weights/card.json").read_text())
    assert card["name"] == "tiny" and card["training"]["frames"] == 34
    assert "CMU" in card["licence"]
    assert [(d["engine"], d["exaggerate"]) for d in card["data"]] == [("physxnet", 1.1)]
    assert "upper_from" not in card["data"][0], "only what was changed is named"
    # Errors on what was learned from: only that the way is whole is asked here.
    measure = ["evaluate", "lbs", run, f"{run}+push", "--data", root, "--split", "train"]
    measure += ["--templates", "bottom", "--out", out]
    assert main([*measure, "--json"]) == 0
    rows = json.loads((tmp_path / "errors.json").read_text())
    assert json.loads(capsys.readouterr().out) == rows
    assert [r["method"] for r in rows] == ["lbs", "run", "run+push"]
    assert all(r["finite_share"] == 1.0 and 0 < r["rmse_vertices_mm"] < 200 for r in rows)
    assert (tmp_path / "errors_vertices.png").is_file()
    assert "better than lbs" in (tmp_path / "errors.md").read_text()
    check_on_ray(measure, rows, tmp_path)
    before = (tmp_path / "errors.json").stat().st_mtime_ns
    assert main([*measure, "--quiet"]) == 0
    assert (tmp_path / "errors.json").stat().st_mtime_ns == before, "nothing is measured twice"
    assert main([*measure, "--times", "--quiet"]) == 0
    again = json.loads((tmp_path / "errors.json").read_text())
    assert [r.pop("ms_per_frame") > 0 for r in again] == [True] * len(rows)
    assert again == [{k: v for k, v in r.items() if k != "ms_per_frame"} for r in rows]
    # Rows of another network, or of another simulation, aren't taken for this one's.
    card_file = tmp_path / "run/weights/card.json"
    text = card_file.read_text()
    card_file.write_text(text.replace(json.loads(text)["sha256"], 64 * "0"))
    assert main([*measure, "--quiet"]) == 2
    assert "another network of that name" in capsys.readouterr().err
    card_file.write_text(text)
    changed = [r | {"data": 16 * "0"} for r in json.loads((tmp_path / "errors.json").read_text())]
    (tmp_path / "old.json").write_text(json.dumps(changed))
    assert main([*measure[:-1], str(tmp_path / "old.json"), "--quiet"]) == 2
    assert "another simulation" in capsys.readouterr().err
    # What a baseline learned from counts where the same engine is the reference.
    learned = rows[0] | {"method": "nearest", "weights": 16 * "0"}
    near = ["evaluate", "nearest", *measure[4:-1], str(tmp_path / "near.json"), "--quiet"]
    for engine, code in (("physxnet", 2), ("blender", 0)):
        (tmp_path / "near.json").write_text(json.dumps([learned | {"engine": engine}]))
        assert main(near) == code
    assert "training set" in capsys.readouterr().err
    for broken in ("{", "[1]", '[{"method": "lbs"}]'):
        (tmp_path / "old.json").write_text(broken)
        assert main([*measure[:-1], str(tmp_path / "old.json"), "--quiet"]) == 2
        assert "not rows that this command can resume from" in capsys.readouterr().err
    # Whose rows are all there needn't be.
    shutil.rmtree(run)
    assert main([*measure, "--quiet"]) == 0
    assert main([*measure[:-1], str(tmp_path / "anew.json"), "--quiet"]) == 2
    capsys.readouterr()
    assert main(["evaluate", run, "elsewhere/run", "--data", root, "--split", "train"]) != 0
    assert "two methods are named run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["dataset", "build", "nowhere.py", "--out", "x"], "no such configuration"),
        (["dataset", "build", "nowhere.py"], "--out"),
        (["dataset", "check", "nowhere"], "no actions"),
        (["evaluate", "lbs", "--data", "nowhere"], "no 'test' actions"),
        (["evaluate", "lbs", "--data", "nowhere", "--out", "x.csv"], ".json"),
    ],
)
def test_missing_inputs_are_reported_in_one_line(words, said, capsys):
    assert main(words) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_invalid_configurations_are_refused(tmp_path, capsys):
    path = tmp_path / "config.toml"
    wrong = (
        ("x = 1", "unknown key 'x'"),
        ("1 / 0", "not TOML"),
        ("batch = 1.5", "expected int"),
        ("schedule = 'steep'", "expected constant, cosine"),
        ("model = { width = 'wide' }", "width is 'wide'"),
    )
    for text, said in wrong:
        path.write_text(text)
        assert main(["train", str(path), "--data", "x", "--out", str(tmp_path / "run")]) == 2
        assert said in " ".join(capsys.readouterr().err.split())
    path.write_text(DATASET)
    assert main(["dataset", "build", f"{path}#set", "--out", "x", "--shard", "2/2"]) == 2
    assert "0 <= i < n" in capsys.readouterr().err
    for name, said in (("none", "there are small, set"), ("loop", "form a cycle")):
        path.write_text(DATASET + '[loop]\nbase = "loop"\n' if name == "loop" else DATASET)
        assert main(["dataset", "build", f"{path}#{name}", "--out", "x"]) == 2
        assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.release
def test_export_command_writes_a_dresser(tmp_path, capsys):
    pytest.importorskip("flatbuffers")
    out = tmp_path / "dresser"
    assert main(["export", "--wear", "bottom", "--out", str(out), "--platforms", "cpu"]) == 0
    assert "wrote" in capsys.readouterr().out
    assert {p.name for p in out.iterdir()} == set(EXPORTED)
    assert main(["export", "--wear", "cape", "--out", str(tmp_path / "no")]) == 2
    assert "one of tee, shirt" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
