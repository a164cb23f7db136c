"""The command: what it writes, what it prints, how it fails."""

import dataclasses
import json
import pathlib
import shlex

import numpy as np
import pytest

from physxnet_jax._environment import check_jaxlib, jaxlib_problem
from physxnet_jax.cli import _dress, main
from physxnet_jax.cli._commands import Dress, Export, View
from physxnet_jax.cli._main import _COMMANDS, parse
from physxnet_jax.dressing import Inference, dress
from physxnet_jax.errors import BrokenInstallError, MotionError, PhysXNetError
from physxnet_jax.evaluation import load_cost_table
from physxnet_jax.garment import load_garment, template
from physxnet_jax.io import read_obj, write_obj
from physxnet_jax.models import DEFAULT


@pytest.mark.parametrize("command", [Dress, Export, View])
def test_commands_default_to_the_default_network(command):
    (field,) = (f for f in dataclasses.fields(command) if f.name == "inference")
    assert field.default_factory().build() == Inference() and Inference().weights == DEFAULT


def test_doctor_and_clips_print_the_installation_and_the_clips(capsys):
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "jaxlib" in out and "cpu" in out
    assert main(["clips"]) == 0
    assert "side step" in capsys.readouterr().out


@pytest.mark.nightly
def test_commands_that_print_tables_also_print_json(tmp_path, capsys, monkeypatch):
    """One text each, whose numbers are those of the table."""

    def run_json(*words):
        code = main([*words, "--json"])
        return code, json.loads(capsys.readouterr().out)

    assert run_json("clips")[1]["templates"] == ["top", "bottom", "dress"]
    code, found = run_json("doctor")
    assert code == 0 and found["problem"] is None and "jaxlib" in found["parts"]
    out = str(tmp_path / "a.npz")
    common = ["--wear", "bottom", "--frames", "2", "-o", out]
    code, found = run_json("dress", "walk", *common, "--method", "lbs")
    assert code == 0 and found["files"] == [out] and found["frames"] == 2
    assert found["garments"][0]["vertices"] == 2726 and 0 <= found["garments"][0]["inside"] < 0.1
    assert {s["name"] for s in found["stages"]} >= {"motion", "skinning"}
    assert found["stages"][-1]["name"] == "other"
    code, found = run_json("simulate", "walk", *common, "--accuracy", "draft")
    assert code == 0 and found["files"] == [out] and "Gravity" in found["effects"]
    assert found["worst"]["strain_p99"] > 0 and found["seconds"] > 0
    garment = template("bottom").mesh
    write_obj(tmp_path / "b.obj", np.asarray(garment.vertices), np.asarray(garment.faces))
    code, found = run_json("fit", str(tmp_path / "b.obj"), "-o", str(tmp_path / "c.obj"))
    assert code == 0 and found["files"] == [str(tmp_path / "c.obj")]
    assert found["result"]["template"] == "bottom"
    code, found = run_json("export-rest", "--wear", "top", "-o", str(tmp_path / "rest"))
    assert code == 0 and [pathlib.Path(f).name for f in found["files"]] == ["body.obj", "top.obj"]
    times = {r.name: dict.fromkeys(r.rmse_mm, 1.5) for r in load_cost_table()}
    monkeypatch.setattr("physxnet_jax.cli._calibrate.measure", lambda *_, **__: times)
    code, found = run_json("calibrate")
    assert {r["method"] for r in found["profiles"]} == set(times)
    assert all(r["ms_per_frame"] == times[r["method"]] for r in found["profiles"])


def test_faulty_jaxlib_versions_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0.10.2")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    with pytest.raises(BrokenInstallError, match="wrong numbers"):
        check_jaxlib()
    assert main(["doctor"]) == 1
    assert "Install another" in capsys.readouterr().out
    assert jaxlib_problem("0.10.2", "--xla_cpu_experimental_ynn_fusion_type=") is None
    assert jaxlib_problem("0.10.1") is None and jaxlib_problem("0.11.0") is not None


@pytest.mark.release
@pytest.mark.parametrize("method", ["network", "lbs"])
def test_dress_writes_and_reports(tmp_path, capsys, method):
    out = tmp_path / "a.npz"
    words = [
        "dress",
        "walk",
        "--wear",
        "top",
        "bottom",
        "-o",
        str(out),
        "--frames",
        "20",
        "--method",
        method,
    ]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "20 frames at 30 fps" in text and "inside the body" in text
    with np.load(out) as data:
        assert data["top_positions"].shape == (20, 3301, 3)
        assert np.isfinite(data["bottom_positions"]).all()
        assert data["body_positions"].shape == (20, 13380, 3)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["dress", "wlak"], "built-in clip"),
        (["dress", "walk", "--wear", "hat"], "a file of triangles"),
        (["dress", "walk", "-o", "a.abc"], "usdc"),
        (["dress", "walk", "--preview", "a.avi"], "preview"),
        (["dress", "walk", "--shape", "tall=1"], "height_up"),
        (["dress", "walk", "--shape", "gender=nan"], "from 0 to 1"),
        (["dress", "walk", "--weights", "none"], "base"),
        (["dress", "walk", "--frames", "0"], "at least one"),
        (["inspect"], "name one"),
        (["fit", "a.obj", "-o", "./a.obj"], "overwrite"),
        (
            ["dress", "walk", "--budget-ms", "5", "--max-error-mm", "9"],
            "either a time (--budget-ms)",
        ),
    ],
)
def test_errors_are_one_sentence_and_exit_code_two(capsys, words, says):
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("physxnet: ") and says in " ".join(error.split())
    assert "Traceback" not in error


@pytest.mark.parametrize("command", list(_COMMANDS))
def test_help_shows_examples_that_are_commands(command, capsys):
    with pytest.raises(SystemExit) as left:
        main([command, "--help"])
    assert left.value.code == 0
    said = capsys.readouterr().out
    examples = [x.strip() for x in said.splitlines() if x.startswith(f"  physxnet {command}")]
    assert "Examples:" in said and examples
    for line in examples:
        assert isinstance(parse(shlex.split(line)[1:]), _COMMANDS[command].options), line


def test_command_list_shows_no_examples(capsys):
    assert main(["--help"]) == 0
    said = capsys.readouterr().out
    assert "Examples" not in said and all(f" {name} " in said for name in _COMMANDS)


def test_interrupts_report_saved_results_and_debug_shows_the_traceback(
    monkeypatch, capsys, tmp_path
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / ".begun.npz.unfinished").mkdir()

    def stopped(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("physxnet_jax.cli._main._run", stopped)
        assert main(["dress", "walk"]) == 130
        assert "nothing half-written" in capsys.readouterr().err
        for words, kept in (
            (["simulate", "walk"], False),
            (["simulate", "walk", "-o", "begun.npz"], True),
            (["dress", "walk", "-o", "begun.npz"], True),
            # Nothing was computed yet, or all of it is written.
            (["simulate", "walk", "-o", "a.npz"], False),
            (["evaluate", "lbs", "--data", "a"], False),
            (["evaluate", "lbs", "--data", "a", "--out", "a.json"], True),
            (["bench", "net", "--out", "a.json"], True),
        ):
            assert main(words) == 130
            assert ("kept for the next run" in capsys.readouterr().err) == kept, words
    with pytest.raises(PhysXNetError, match="built-in clip"):
        main(["dress", "wlak", "--debug"])


def test_memory_that_ends_is_one_sentence(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / ".begun.npz.unfinished").mkdir()
    numpys = "Unable to allocate 8.2 GiB for an array with shape (1, 2)"
    for error, said in (
        (MemoryError(numpys), numpys),
        (MemoryError(), "memory ended: MemoryError."),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.\nmore"), "9 bytes."),
    ):

        def ended(*_, error=error):
            raise error

        with monkeypatch.context() as patched:
            patched.setattr("physxnet_jax.cli._main._run", ended)
            assert main(["dress", "walk", "-o", "begun.npz"]) == 2
        found = capsys.readouterr().err
        assert said in found and "kept for the next run" in found and "--frames" in found

    def failed(*_):
        raise RuntimeError("something else")

    monkeypatch.setattr("physxnet_jax.cli._main._run", failed)
    with pytest.raises(RuntimeError, match="something else"):
        main(["dress", "walk"])


@pytest.mark.release
def test_a_clip_that_cannot_be_written_for_memory_is_kept(monkeypatch, capsys, tmp_path):
    write = _dress.write_clip

    def ended(path, *args, **options):
        if path.suffix == ".glb":
            raise MemoryError("12 GB")
        return write(path, *args, **options)

    monkeypatch.setattr(_dress, "write_clip", ended)
    words = ["dress", "walk", "--wear", "bottom", "--method", "lbs", "--frames", "2"]
    assert main([*words, "-o", str(tmp_path / "a.glb")]) == 2
    assert "12 GB" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["a.kept.npz"]
    with np.load(tmp_path / "a.kept.npz") as file:
        assert len(file["bottom_positions"]) == 2


def test_shell_completion_covers_all_commands(capsys):
    with pytest.raises(SystemExit):
        main(["--tyro-print-completion", "bash"])
    said = capsys.readouterr().out
    assert "physxnet" in said and all(name in said for name in _COMMANDS)


def test_joint_map_is_passed_to_the_reader(tmp_path, capsys):
    path = tmp_path / "names.toml"
    path.write_text('Hips = "pelvis"\n')
    (tmp_path / "a.bvh").write_text(
        "HIERARCHY\nROOT pelvis\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n"
        "End Site\n{\nOFFSET 0 1 0\n}\n}\nMOTION\nFrames: 1\nFrame Time: 0.1\n0 0 0\n"
    )
    for words in (["dress"], ["simulate"], ["effects"]):
        words = [*words, str(tmp_path / "a.bvh"), "--joint-map", str(path)]
        assert main(words) == 2
        # Without the map the names themselves would be unknown.
        assert "the joint map lacks" in " ".join(capsys.readouterr().err.split())
        assert main(words[:2]) == 2
        assert "unknown joints" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("command", ["dress", "simulate", "effects", "view"])
def test_skeleton_and_source_rate_are_passed_to_the_reader(command, tmp_path, monkeypatch):
    asked = []

    def read(motion, **options):
        asked.append(options)
        raise MotionError("enough")

    monkeypatch.setattr("physxnet_jax.cli._dress.load_motion", read)
    monkeypatch.setattr("physxnet_jax.motion._prepare.load_motion", read)
    words = ["--skeleton", "b.asf", "--source-fps", "60"]
    words += ["--html", str(tmp_path / "a.html")] if command == "view" else []
    assert main([command, "a.amc", *words]) == 2
    assert asked[0]["skeleton"] == pathlib.Path("b.asf") and asked[0]["source_fps"] == 60.0


@pytest.mark.release
def test_exported_rest_body_and_garments_reload_in_place(tmp_path, body, rest):
    assert main(["export-rest", "-o", str(tmp_path), "--wear", "top"]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["body.obj", "top.obj"]
    skin = read_obj(tmp_path / "body.obj")
    np.testing.assert_allclose(skin.vertices, body.rest_mesh().vertices, atol=1e-6)
    assert skin.faces.shape == body.rest_mesh().faces.shape and skin.uv is not None
    # What is modelled on it is worn where it was modelled.
    again, report = load_garment(tmp_path / "top.obj")
    assert (report.unit, report.up, again.template) == ("m", "Y", "top")
    np.testing.assert_allclose(again.mesh.vertices, template("top").mesh.vertices, atol=0.004)
    large = tmp_path / "large"
    words = ["export-rest", "--wear", "top", "--shape", "weight_up=1", "-o", str(large), "--quiet"]
    assert main(words) == 0
    shape = body.shape(weight_up=1.0)
    found = read_obj(large / "top.obj").vertices
    expected = template("top").rest_vertices(body.rest_vertices(shape))
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.release
def test_other_body_shapes_stand_on_the_floor(tmp_path):
    out = tmp_path / "a.npz"
    words = [
        "dress",
        "balance",
        "--wear",
        "bottom",
        "--shape",
        "gender=1",
        "-o",
        str(out),
        "--frames",
        "4",
        "--quiet",
    ]
    assert main(words) == 0
    with np.load(out) as data:
        assert abs(float(data["body_positions"][..., 1].min())) < 0.01


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--method", "simulate", "--budget-ms", "5"], "leave out --method"),
        (["--weights", "small", "--max-error-mm", "9"], "leave out --weights"),
        (["--no-collisions", "--budget-ms", "5"], "leave out --collisions"),
        (["--accuracy", "fine"], "--accuracy is for whole simulations"),
        (["--method", "lbs", "--wind", "0", "0", "1"], "--wind is an option of the simulator"),
        (["--method", "network", "--weights", "paper", "--fabric", "silk"], "paper sees no fabric"),
        (["--method", "lbs", "--wear", "top:fabric=silk"], "skinning sees no fabric"),
        (["--method", "lbs", "--weights", "small"], "--method lbs has none"),
        (["--animation", "Run"], "one glTF file"),
        (["--camera", "front"], "add --preview FILE"),
        (["--preview", "a.png", "--background", "mauve"], "no background 'mauve'"),
        (["-o", "a.npz", "--velocities"], "--velocities is for USD"),
        (["--method", "lbs", "--strict"], "--strict is for cloth that is simulated"),
        (["--start", "9"], "start is 9.0 s, but walk lasts from 0 to 4.00 s"),
        (["--start", "-1"], "start is -1.0 s"),
        (["-o", "/proc/x.npz"], "nothing can be written there"),
        (["--preview", "/proc/x.png"], "nothing can be written there"),
    ],
)
def test_conflicting_options_are_refused(words, said, capsys):
    wear = [] if "--wear" in words else ["--wear", "top"]
    assert main(["dress", "walk", *wear, *words]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.release
def test_missing_output_is_reported_and_start_selects_frames(capsys, tmp_path):
    words = ["dress", "walk", "--wear", "bottom", "--method", "lbs", "--frames", "2"]
    assert main(words) == 0
    assert "nothing will be written" in capsys.readouterr().out
    assert main([*words, "-o", str(tmp_path / "a.npz"), "--start", "1"]) == 0
    assert "nothing will be written" not in capsys.readouterr().out
    late = np.load(tmp_path / "a.npz")["bottom_positions"]
    whole = dress("walk", ["bottom"], method="lbs", frames=32).garments[0].positions
    np.testing.assert_allclose(late, whole[30:32], atol=1e-6)
    # A start within the last frame is that frame.
    assert main([*words, "-o", str(tmp_path / "b.npz"), "--start", "3.99"]) == 0
    assert np.load(tmp_path / "b.npz")["bottom_positions"].shape[0] == 1


@pytest.mark.release
def test_captured_bvh_wears_a_garment_file_and_exports_usd(data_dir, tmp_path, capsys):
    """A BVH of a motion library and an OBJ of somebody's shirt, into a stage that others read."""
    Usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    dance, shirt = data_dir / "mocap/daz/060_10.bvh", data_dir / "garments/tee.obj"
    out = tmp_path / "salsa.usdc"
    words = ["dress", dance, "--wear", shirt, "bottom", "--frames", "3", "-o", out]
    assert main([str(w) for w in words]) == 0
    assert "wrote" in capsys.readouterr().out
    stage = Usd.Stage.Open(str(out))
    found = {p.GetName(): UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)}
    assert {"tee", "bottom"} <= set(found)
    file = read_obj(shirt)
    first, last = (
        np.asarray(found["tee"].GetPointsAttr().Get(t)) for t in (0, stage.GetEndTimeCode())
    )
    assert first.shape == last.shape == np.shape(file.vertices)
    assert np.isfinite(first).all() and np.abs(last - first).max() > 1e-3
    height = np.ptp(first[:, 1])
    assert 0.4 < height < 1.2, "in metres, on the dancer"


@pytest.mark.release
def test_brackets_in_paths_are_not_parsed_as_markup(tmp_path, capsys):
    out = tmp_path / "walk[v2][/].npz"
    assert main(["dress", "walk", "--wear", "bottom", "--method", "lbs", "--frames", "2",
                 "-o", str(out)]) == 0  # fmt: skip
    assert "walk[v2][/].npz" in capsys.readouterr().out.replace("\n", "")


def test_budget_and_error_limit_together_are_refused_before_reading(capsys):
    words = ["--budget-ms", "5", "--max-error-mm", "20", "--character", "none.glb"]
    assert main(["dress", "walk", "--wear", "top", *words]) == 2
    assert "either a time" in capsys.readouterr().err


def test_a_file_that_cannot_be_read_hides_no_other(tmp_path, capsys):
    gone = [str(tmp_path / name) for name in ("gone.bvh", "lost.bvh")]
    assert main(["inspect", gone[0], "walk", "--json"]) == 2
    said = capsys.readouterr()
    (found,) = json.loads(said.out)
    assert found["path"] == "walk" and "gone.bvh" in said.err
    assert main(["inspect", *gone]) == 2
    said = "".join(capsys.readouterr().err.split())
    assert "gone.bvh" in said and "lost.bvh" in said


@pytest.mark.release
def test_what_a_person_should_look_at_is_said_at_the_end(monkeypatch, capsys):
    words = ["walk", "--wear", "bottom", "--frames", "2"]
    runs = (["dress", *words, "--method", "lbs"], ["simulate", *words, "--accuracy", "draft"])
    for limit, said in ((1.0, False), (-1.0, True)):
        monkeypatch.setattr(_dress, "_MUCH_INSIDE", limit)
        for run in runs if said else runs[:1]:
            assert main([*run, "--json"]) == 0
            notes = json.loads(capsys.readouterr().out)["notes"]
            assert any("vertices are inside" in n for n in notes) == said
            assert main(run) == 0
            assert ("vertices are inside" in capsys.readouterr().out) == said
