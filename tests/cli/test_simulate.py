"""`physxnet simulate` and `physxnet effects`: scenes, resuming, what is said and written."""

import dataclasses
import json
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from physxnet_jax.cli import main
from physxnet_jax.cli._progress import print_json
from physxnet_jax.dressing import (
    Inference,
    Simulation,
    dress,
    load_scene,
    make_dresser,
    make_scene,
    write_scene,
)
from physxnet_jax.errors import (
    FormatError,
    MissingDependencyError,
    MotionError,
    PhysXNetError,
    SimulationError,
)
from physxnet_jax.evaluation import judge_effects, price_effects, recommend_effects
from physxnet_jax.evaluation._price import Price
from physxnet_jax.garment import FABRICS, square_sheet, template
from physxnet_jax.io import write_obj
from physxnet_jax.motion import body_animation, load_motion
from physxnet_jax.simulation import (
    PRESETS,
    STANDARD,
    XPBD,
    Effect,
    Rollout,
    Scene,
    prepare_scene,
    simulate_batch,
)
from physxnet_jax.simulation.blender import find_blender
from physxnet_jax.simulation.effects import (
    Air,
    BodyContact,
    Damping,
    Floor,
    Gravity,
    LayerContact,
    Membrane,
    Pin,
    Seam,
    Stretch,
)

TOML = """
motion = "balance"
frames = 4
accuracy = "draft"
[[garments]]
file = "bottom"
fabric = "silk"
[effects.air]
wind = [0, 0, 4]
"""


@pytest.mark.release
def test_scene_files_are_simulated_and_written(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    scene.write_text(TOML)
    out = tmp_path / "a.npz"
    assert main(["simulate", str(scene), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "Air" in said and "deepest penetration of the skin" in said
    with np.load(out) as data:
        assert data["bottom_positions"].shape == (4, 2726, 3)
        assert np.isfinite(data["bottom_positions"]).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "scene.toml"]


@pytest.mark.nightly
def test_only_frames_can_override_a_scene_file(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    scene.write_text(TOML)
    out = tmp_path / "a.npz"
    assert main(["simulate", str(scene), "--frames", "2", "-o", str(out), "--quiet"]) == 0
    with np.load(out) as data:
        plain = data["bottom_positions"]
        assert plain.shape[0] == 2
    words = ["simulate", str(scene), "--frames", "2", "--refine", "0.02", "-o", str(out), "--quiet"]
    assert main(words) == 0
    with np.load(out) as data:
        assert data["bottom_positions"].shape == plain.shape
        assert np.abs(data["bottom_positions"] - plain).max() > 1e-3, "refined"
    words[words.index("--refine") : words.index("-o")] = ["--substeps", "3"]
    assert main(words) == 0
    with np.load(out) as data:
        assert np.abs(data["bottom_positions"] - plain).max() > 1e-5, "other steps"
    assert main(["simulate", str(scene), "--frames", "0"]) == 2
    assert "at least one" in capsys.readouterr().err
    for words in (["--wear", "dress"], ["--fps", "25"], ["--wind", "0", "0", "1"]):
        assert main(["simulate", str(scene), *words]) == 2
        assert f"leave {words[0]} out" in " ".join(capsys.readouterr().err.split())
    assert main(["effects", str(scene), "--wear", "top"]) == 2
    assert "leave --wear out" in " ".join(capsys.readouterr().err.split())


@pytest.mark.release
def test_scene_files_define_garments_effects_and_motion(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(TOML)
    job = load_scene(path)
    assert job.scene.garments[0].fabric.density == 0.07
    assert Air(wind=(0.0, 0.0, 4.0)) in job.scene.effects
    assert job.motion.num_frames == 4 and job.accuracy == "draft"
    listed = "[effects.gravity]\n[effects.stretch]\ncompression = 1\n"
    path.write_text(f'motion = "walk"\nstandard = false\n{listed}')
    assert load_scene(path).scene.effects == (Gravity(), Stretch(compression=1.0))
    path.write_text(f'motion = "walk"\ngarments = ["bottom"]\n{listed}')
    added = load_scene(path).scene.effects
    assert [type(e) for e in added] == [type(e) for e in STANDARD]
    assert Stretch(compression=1.0) in added
    path.write_text('motion = "walk"\ngarments = ["bottom"]\n[effects.membrane]\n[effects.floor]\n')
    kinds = {type(e) for e in load_scene(path).scene.effects}
    assert {Membrane, Floor} <= kinds and Stretch not in kinds, "one law of stretching"
    path.write_text('motion = "walk"\n[effects.seam]\nstitches = [[0, 5], [1, 6]]\n')
    assert Seam(stitches=((0, 5), (1, 6))) in load_scene(path).scene.effects
    both = make_scene("walk", ["top", "bottom"])
    assert [g.name for g in both.scene.garments] == ["bottom", "top"], "the innermost first"
    assert LayerContact() in both.scene.effects


class Sway(Effect):
    """A custom effect."""


def test_fabrics_of_scene_files_may_be_numbers(tmp_path):
    path, copy = tmp_path / "scene.toml", tmp_path / "copy.toml"
    path.write_text(
        'motion = "walk"\nframes = 2\n[[garments]]\nfile = "bottom"\n'
        'fabric = {base = "silk", density = 0.3, thickness = 0.01}\n'
    )
    read = load_scene(path)
    fabric = read.scene.garments[0].fabric
    assert (fabric.density, fabric.thickness) == (0.3, 0.01)
    assert fabric.stretch == FABRICS["silk"].stretch
    write_scene(copy, read, read.scene.effects)
    again = load_scene(copy)
    assert again.scene.garments[0].fabric == fabric and again.scene.effects == read.scene.effects


@pytest.mark.release
def test_chosen_vertices_are_pinned(tmp_path):
    path, copy, out = (tmp_path / n for n in ("scene.toml", "copy.toml", "a.npz"))
    text = (
        'motion = "walk"\nframes = 3\naccuracy = "draft"\n[[garments]]\nfile = "bottom"\n'
        "pin = [5, 2000]\n"
    )
    path.write_text(text)
    read = load_scene(path)
    (garment,) = read.scene.garments
    own = np.asarray(template("bottom").pinned)
    assert not own[[5, 2000]].any(), "the control: they aren't pinned otherwise"
    added = np.flatnonzero(np.asarray(garment.pinned) & ~own)
    assert added.tolist() == [5, 2000]
    write_scene(copy, read, read.scene.effects)
    assert (np.asarray(load_scene(copy).scene.garments[0].pinned) == garment.pinned).all()
    inference = Inference(collisions=False)
    clip = dress("walk", "bottom", method="lbs", inference=inference, frames=3)
    skinned = np.asarray(clip.garments[0].positions)
    assert main(["simulate", str(path), "-o", str(out), "--quiet"]) == 0
    with np.load(out) as data:
        away = np.linalg.norm(data["bottom_positions"] - skinned, axis=-1)
    assert away[:, [5, 2000]].max() < 1e-5 and away[:, ~own].max() > 1e-3
    for pins, why in (
        ("[2726]", "no vertex 2726; its 2726"),
        ("[-1]", "first of which is 0"),
        ("5", "list of vertex"),
        ("[1.5]", "list of vertex"),
        ("[true]", "list of vertex"),
    ):
        path.write_text(text.replace("[5, 2000]", pins))
        with pytest.raises(FormatError, match=why):
            load_scene(path)


def test_scenes_keep_custom_effects_and_refuse_duplicates():
    wind = Air(wind=(0.0, 0.0, 4.0))
    scene = make_scene(
        "walk", "bottom", simulation=Simulation(effects=(Pin(), Sway(), Gravity(), wind))
    ).scene
    assert [type(e) for e in scene.effects] == [Gravity, Air, Sway, Pin]
    calm = Air(wind=(0.0, 0.0, 0.0))
    assert make_scene(
        "walk", "bottom", simulation=Simulation(effects=(wind,)), also=[calm]
    ).scene.effects == (calm,)
    twice = make_scene("walk", "bottom", simulation=Simulation(effects=(wind, calm))).scene
    with pytest.raises(SimulationError, match="listed twice"):
        prepare_scene(twice)


@pytest.mark.parametrize(
    "words",
    [
        ["--engine", "blender", "--wind", "0", "0", "4"],
        ["--engine", "newton", "--self-contact"],
        ["--engine", "blender", "--accuracy", "fine"],
        ["--engine", "bdf2", "--accuracy", "fine"],
    ],
)
def test_options_an_engine_cannot_apply_are_refused(words, capsys):
    assert main(["simulate", "walk", "--wear", "bottom", *words]) == 2
    assert "leave" in capsys.readouterr().err


@pytest.mark.release
def test_garment_paths_resolve_relative_to_the_scene_file(tmp_path, monkeypatch):
    mesh = template("bottom").mesh
    (tmp_path / "in").mkdir()
    write_obj(tmp_path / "in/a.obj", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    text = (tmp_path / "in/a.obj").read_text()
    (tmp_path / "in/a.obj").write_text(text.replace("\nf ", "\no legs\nf ", 1))
    monkeypatch.chdir(tmp_path)
    for word in ("a.obj", "a.obj#legs", "a.obj:as=bottom", "a.obj#legs:as=bottom"):
        (tmp_path / "in/s.toml").write_text(f'motion = "walk"\ngarments = ["{word}"]\n')
        (garment,) = load_scene(tmp_path / "in/s.toml", frames=2).scene.garments
        assert garment.template == "bottom"


@pytest.mark.nightly
def test_notes_of_garment_files_match_dress(tmp_path, capsys):
    mesh = template("bottom").mesh
    vertices = np.array(mesh.vertices)
    # Caught on a nail: its edges are too long to fold.
    vertices[np.argmax(vertices[:, 2])] += [0.0, 0.0, 0.08]
    write_obj(tmp_path / "caught.obj", vertices, np.asarray(mesh.faces))
    scene = tmp_path / "scene.toml"
    scene.write_text(TOML.replace('"bottom"', '"caught.obj:as=bottom"'))
    (note,) = load_scene(scene).notes
    assert "caught.obj" in note and "physxnet" in note
    assert load_scene(scene).scene.garments[0].fabric.density == 0.07, "the fabric is the scene's"
    assert main(["simulate", str(scene), "--frames", "2"]) == 0
    assert note in capsys.readouterr().out, "in one line, for its command to be copied"
    assert main(["simulate", str(scene), "--frames", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["notes"] == [note]
    assert not make_scene("walk", ["bottom"]).notes
    (told,) = make_dresser(
        [f"{tmp_path / 'caught.obj'}:as=bottom"],
        inference=Inference(weights="nano", strain_iterations=0),
    ).notes
    assert told == note
    assert not make_dresser(
        ["bottom"], inference=Inference(weights="nano", strain_iterations=0)
    ).notes


@pytest.mark.release
def test_resume_folder_with_other_files_is_neither_used_nor_removed(tmp_path):
    scene = prepare_scene(
        Scene((square_sheet(5, pinned=np.arange(5)),), (Gravity(), Stretch(), Pin()))
    )
    motion = load_motion("balance", fps=10.0)
    theirs = tmp_path / "results"
    theirs.mkdir()
    (theirs / "thesis.txt").write_text("years")
    with pytest.raises(SimulationError, match="don't belong to a rollout"):
        simulate_batch(scene, [motion], solver=XPBD(8, 2), resume=theirs)
    assert [p.name for p in theirs.iterdir()] == ["thesis.txt"]
    keep = tmp_path / "keep"

    def put(done, total):
        (keep / "notes.txt").write_text("mine")

    simulate_batch(scene, [motion], solver=XPBD(8, 2), resume=keep, progress=put)
    assert [p.name for p in keep.iterdir()] == ["notes.txt"]


def test_motions_are_simulated_at_the_requested_rate():
    walk = load_motion("walk", fps=60.0)
    assert make_scene(walk, ["bottom"]).motion.fps == 60.0
    half = make_scene(walk, ["bottom"], fps=30.0).motion
    assert half.fps == 30.0 and half.num_frames == -(-walk.num_frames // 2)
    assert make_scene("walk", ["bottom"]).motion.fps == 30.0
    spoiled = dataclasses.replace(walk, root=walk.root.at[3].set(np.nan))
    with pytest.raises(MotionError, match="frame 3"):
        make_scene(spoiled, ["bottom"])


@pytest.mark.release
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("motion = ", "TOML"),
        ("fps = 3.0", "no key motion"),
        ('motion = "walk"\nsource_fps = -1', "source_fps is -1"),
        ('motion = "a.amc"\nskeleton = 3', "skeleton can't be 3"),
        ('motion = "walk"\nwear = ["top"]', "unknown key wear"),
        ('motion = "walk"\n[effects.rain]', "no effect 'rain'"),
        ('motion = "walk"\n[effects.air]\nstorm = 1', "air has no 'storm'"),
        ('motion = "walk"\n[effects.stretch]\ncompression = 0', "stretch: compression is 0"),
        ('motion = "walk"\n[effects.membrane]\ncompression = -1', "membrane: compression is -1"),
        (
            'motion = "walk"\n[effects.body_contact]\nhops = 2.5',
            "hops is 2.5, expected a whole number",
        ),
        ('motion = "walk"\n[effects.body_contact]\nhops = true', "hops is True, expected a whole"),
        ('motion = "walk"\n[effects.seam]\nstitches = [0, 5]', "stitches is a list of lists"),
        (
            'motion = "walk"\n[effects.seam]\nstitches = [[0, 5, 6]]',
            r"(?s)seam: .*(pair of vertices|stitches)",
        ),
        ('motion = "walk"\n[effects.seam]\nstitches = [[0, 5.5]]', "a whole number"),
        ('motion = "walk"\n[effects.air]\nwind = [[0, 0, 4]]', "wind is not a list of lists"),
        ('motion = "walk"\n[shape]\nself = 1', "Unknown shape parameter"),
        ('motion = "walk"\naccuracy = "best"', "draft, standard, fine"),
        ('motion = "walk"\n[[garments]]\nfile = "top"\nfabric = "tin"', "cotton"),
        ('motion = "walk"\n[[garments]]\nname = "top"', "file, fabric and pin, not name"),
        ('motion = "walk"\nup = "x"', "up is y or z"),
        ('motion = "walk"\nstandard = 1', "standard can't be 1"),
        ('motion = "walk"\n[[garments]]\nfile = "top"\nfabric = {hue = 1}', "no 'hue'"),
        ('motion = "walk"\n[[garments]]\nfile = "top"\nfabric = {bend = -1}', "bend is -1"),
        ('motion = "walk"\n[[garments]]\nfile = "top"\nfabric = {bend = "soft"}', "a number"),
        ('motion = "walk"\n[[garments]]\nfile = "top"\nfabric = {base = "tin"}', "cotton"),
    ],
)
def test_wrong_scene_files_are_refused_with_a_fix(tmp_path, text, says):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(PhysXNetError, match=says):
        load_scene(path)


@pytest.mark.release
def test_resumed_rollout_matches_an_uninterrupted_one(tmp_path):
    scene = prepare_scene(
        Scene((square_sheet(5, pinned=np.arange(5)),), (Gravity(), Stretch(), Pin()))
    )
    motion = load_motion("balance", fps=10.0)
    solver = XPBD(8, 2)
    whole = simulate_batch(scene, [motion], solver=solver)[0]
    seen = []

    def stop(done, total):
        seen.append(done)
        if len(seen) == 2:
            raise KeyboardInterrupt

    keep = tmp_path / "unfinished"
    with pytest.raises(KeyboardInterrupt):
        simulate_batch(scene, [motion], solver=solver, progress=stop, resume=keep)
    assert len(list(keep.glob("block_*.npz"))) == 2
    with pytest.raises(SimulationError, match="another scene"):
        simulate_batch(scene, [motion], solver=XPBD(16, 2), resume=keep)
    slower = dataclasses.replace(motion, fps=9.99)
    with pytest.raises(SimulationError, match="another scene"):
        simulate_batch(scene, [slower], solver=solver, resume=keep)
    last = max(keep.glob("block_*.npz"))
    blob = last.read_bytes()
    for bad in (blob[: len(blob) // 2], b"", b"never"):
        last.write_bytes(bad)
        with pytest.raises(SimulationError, match=r"block_00001\.npz: damaged"):
            simulate_batch(scene, [motion], solver=solver, resume=keep)
    last.write_bytes(blob)
    again = []
    rest = simulate_batch(
        scene, [motion], solver=solver, progress=lambda d, t: again.append(d), resume=keep
    )[0]
    assert again[0] > seen[-1], "what was done isn't done again"
    np.testing.assert_array_equal(rest.positions[0], whole.positions[0])
    np.testing.assert_array_equal(rest.diagnostics["speed_max"], whole.diagnostics["speed_max"])
    assert not keep.exists()


@pytest.mark.nightly
def test_effect_costs_separate_relevant_from_irrelevant_effects(tmp_path, capsys):
    # A sheet pinned to the hips a metre and a half before the body: no contact, little air.
    g = square_sheet(5, pinned=np.arange(5))
    motion = load_motion("balance", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:10], root=motion.root[:10])
    scene = Scene((g,), (Gravity(), Stretch(), BodyContact(), Pin()))
    solver = XPBD(4, 1)
    rows, found = recommend_effects(scene, motion, solver=solver)
    by = {r.without: r for r in rows}
    assert list(by) == ["", "Gravity", "Stretch", "BodyContact", "Pin"]
    assert by[""].rms_mm == 0 and by["BodyContact"].rms_mm == 0
    assert by["Gravity"].rms_mm > 10 and by["Pin"].rms_mm > 100
    assert by["BodyContact"].mflop < by[""].mflop and by["Gravity"].mflop < by[""].mflop
    assert by["Stretch"].strain_p99 > by[""].strain_p99
    advice = {a.effect: a for a in found}
    assert advice["Gravity"].needed and advice["Pin"].needed
    assert not advice["BodyContact"].needed
    assert not advice["SelfContact"].needed and "Cloth never comes" in advice["SelfContact"].why


@pytest.mark.release
def test_effects_command_prints_and_writes_its_table(tmp_path, capsys, monkeypatch):
    path, rows = tmp_path / "scene.toml", tmp_path / "rows.json"
    path.write_text(
        'motion = "balance"\nframes = 2\naccuracy = "draft"\ngarments = ["bottom"]\n'
        "standard = false\n[effects.gravity]\n[effects.body_contact]\n"
    )
    measured = []

    def price(*words, **more):
        measured[:] = measured or price_effects(*words, **more)
        return measured

    monkeypatch.setattr("physxnet_jax.cli._effects.price_effects", price)
    assert main(["effects", str(path), "-o", str(rows)]) == 0
    said = capsys.readouterr().out
    assert "BodyContact" in said and "inside" in said
    data = json.loads(rows.read_text())["effects"]
    assert [r["without"] for r in data] == ["", "Gravity", "BodyContact"]
    assert data[2]["mflop"] < data[0]["mflop"] and data[1]["rms_mm"] > 100
    assert main(["effects", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["effects"] == data
    assert data[0]["jitter_mm"] == data[2]["jitter_mm"] > 0


@pytest.mark.release
def test_an_idle_effect_costs_nothing_and_shifts_no_other():
    sheet = square_sheet(5, 0.2)
    motion = dataclasses.replace(load_motion("walk", fps=30.0)[:3], name="walk")
    effects = (Damping(rate=0.0), Gravity(), Stretch())
    rows = price_effects(Scene((sheet,), effects), motion, solver=XPBD(4, 1))
    found = {r.without: r.max_mm for r in rows}
    assert found["Damping"] == 0.0
    # A third of a second of free fall goes with gravity, and nothing else does.
    assert found["Gravity"] > 20.0 > 5.0 > found["Stretch"]


@pytest.mark.nightly
def test_recommended_scene_is_written_and_simulated(tmp_path, capsys):
    needed = tmp_path / "needed.toml"
    words = ["effects", "balance", "--wear", "bottom:fabric=silk", "--frames", "2"]
    words += ["--accuracy", "draft", "--recommend", "--write-scene", str(needed)]
    assert main(words) == 0
    assert "Gravity: needed" in capsys.readouterr().out
    scene = load_scene(needed)
    kinds = {type(e) for e in scene.scene.effects}
    assert {Gravity, Pin} <= kinds and scene.accuracy == "draft"
    assert (
        scene.scene.garments[0].fabric.bend == FABRICS["silk"].bend and scene.motion.num_frames == 2
    )
    other = str(tmp_path / "other.toml")
    assert main(["effects", "balance", "--write-scene", other]) == 2
    assert "add --recommend" in capsys.readouterr().err


def test_changes_below_the_noise_floor_are_no_measurable_effect():
    base = Price("", 2, 0.0, 0.0, 0.1, 0.0, 10.0, 1.0, 1.0, 6.0)
    rows = [
        base,
        *(dataclasses.replace(base, without=n, rms_mm=m) for n, m in (("A", 5.0), ("B", 7.0))),
    ]
    below, above = judge_effects(rows)
    assert not below.needed and below.why.startswith("No measurable effect")
    assert above.needed and "No measurable" not in above.why


def test_scene_of_objects_in_memory_is_not_written(tmp_path):
    scene = make_scene(load_motion("balance", fps=30.0), ["bottom"])
    with pytest.raises(FormatError, match="objects in memory"):
        write_scene(tmp_path / "a.toml", scene, ())


def test_missing_blender_error_names_the_environment_variable(monkeypatch):
    monkeypatch.setenv("PHYSXNET_BLENDER", "/nowhere/blender")
    with pytest.raises(MissingDependencyError, match="PHYSXNET_BLENDER"):
        find_blender()


@pytest.mark.nightly
def test_rollout_fingerprint_is_equal_across_processes():
    """What is kept is found again by the next process, whose memory lies elsewhere."""
    code = (
        "from physxnet_jax.simulation import PRESETS, Scene, prepare_scene, XPBD\n"
        "from physxnet_jax.simulation._resume import fingerprint\n"
        "from physxnet_jax.garment import square_sheet\n"
        "pad = [object() for _ in range({pad})]\n"
        "if {network}:\n"
        "    import physxnet_jax as px\n"
        "    print(fingerprint(px.make_dresser(['shorts'], inference=px.Inference(weights='nano'))))\n"
        "    raise SystemExit\n"
        "scene = prepare_scene(Scene((square_sheet(12, 0.5),)))\n"
        "print(fingerprint(scene, (XPBD({steps}, 2), True)))\n"
    )

    def name(pad, steps=8, network=False):
        text = code.format(pad=pad, steps=steps, network=network)
        words = [sys.executable, "-c", text]
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()[-1]

    first = name(0)
    assert len(first) == 64 and name(100_000) == first
    # The control: another setting is another rollout.
    assert name(0, steps=16) != first
    # A network's structure names functions.
    assert name(0, network=True) == name(100_000, network=True) != first


def test_loaded_motion_stands_on_the_floor_for_other_shapes(body):
    clip = load_motion("walk", fps=30)
    tall = body.shape(height_up=1.0)
    low = []
    for motion in (clip, "walk"):
        job = make_scene(motion, ["top"], shape=tall, frames=4)
        person = body_animation(body, job.motion, tall)
        low.append(float(np.asarray(person)[..., 1].min()))
    assert low[0] == pytest.approx(low[1], abs=0.01) and abs(low[0]) < 0.03
    sunk = body_animation(body, clip, tall)
    assert float(np.asarray(sunk)[..., 1].min()) < -0.05, "the control: as it was loaded"


@pytest.mark.parametrize("word", ["source_fps", "skeleton", "joint_map"])
def test_file_options_are_refused_for_a_loaded_motion(word):
    value = 60.0 if word == "source_fps" else "a.asf"
    with pytest.raises(MotionError, match=f"{word} is for motion files"):
        make_scene(load_motion("walk", fps=30), ["top"], **{word: value})


def test_json_output_is_valid_for_non_finite_values(capsys):
    print_json({"gap": np.inf, "x": [1.0, float("nan")], "path": pathlib.Path("a")})
    told = json.loads(capsys.readouterr().out, parse_constant=lambda c: pytest.fail(c))
    assert told == {"gap": None, "x": [1.0, None], "path": "a"}
    gaps = np.array([0.5, 0.1, 0.2])
    rollout = Rollout((), 30.0, {"finite": np.ones(3), "self_gap": gaps, "strain_max": gaps})
    assert rollout.worst == {"self_gap": 0.1, "strain_max": 0.5}


@pytest.mark.release
def test_guided_takes_fabric_wind_and_substeps_alone(tmp_path, capsys):
    words = ["dress", "walk", "--wear", "bottom:fabric=silk", "--method", "guided", "--frames", "3"]
    words += ["--weights", "nano", "--wind", "0", "0", "4", "--substeps", "4"]
    assert main([*words, "-o", str(tmp_path / "silk.npz")]) == 0
    assert (tmp_path / "silk.npz").is_file()
    capsys.readouterr()
    for given, says in ((["--accuracy", "fine"], "use --substeps"), (["--tta"], None)):
        code = main([*words, *given, "-o", str(tmp_path / "other.npz")])
        assert code == (2 if says else 0)
        assert (says or "") in capsys.readouterr().err
    assert main([*words, "--strain-iterations", "2", "-o", str(tmp_path / "no.npz")]) == 2
    assert "--method guided has none" in " ".join(capsys.readouterr().err.split())


def test_substeps_of_a_scene_file(tmp_path, monkeypatch):
    """They act unless the command asks for others, or for an accuracy."""
    from physxnet_jax.cli import _dress

    scene = tmp_path / "scene.toml"
    scene.write_text('motion = "balance"\nframes = 2\ngarments = ["bottom"]\nsubsteps = 24\n')
    found = []

    def note(job, *_):
        found.append(job.simulation.solver)
        raise PhysXNetError("seen")

    monkeypatch.setattr(_dress, "_run", note)
    for words in ((), ("--substeps", "48"), ("--accuracy", "draft")):
        assert main(["simulate", str(scene), "-o", str(tmp_path / "a.npz"), *words]) == 2
    assert [s.substeps for s in found] == [24, 48, PRESETS["draft"].substeps]
    kept = load_scene(scene)
    write_scene(tmp_path / "again.toml", kept, kept.scene.effects)
    assert kept.substeps == load_scene(tmp_path / "again.toml").substeps == 24
    scene.write_text('motion = "balance"\nsubsteps = 0\n')
    with pytest.raises(FormatError, match="substeps is 0"):
        load_scene(scene)


@pytest.mark.release
def test_accuracy_of_a_scene_file_concerns_no_other_engine(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    few = 'motion = "balance"\naccuracy = "draft"\ngarments = ["bottom"]\nstandard = false\n'
    scene.write_text(f"{few}[effects.gravity]\n")
    words = ["simulate", str(scene), "--engine", "bdf2", "--frames", "1", "--quiet"]
    assert main([*words, "-o", str(tmp_path / "a.npz")]) == 0
    assert main([*words, "--accuracy", "fine"]) == 2
    assert "xpbd only" in " ".join(capsys.readouterr().err.split())
