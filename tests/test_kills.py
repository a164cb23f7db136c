"""What is killed at any moment and started again ends with the bytes of an undisturbed run.

In JSON files measured times may differ; tables and charts of such times need only be there.
"""

import contextlib
import json
import os
import pathlib
import random
import runpy
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from physxnet_jax._environment import compilation_cache_folder
from physxnet_jax.data import dataset_digest

_DEVICES = runpy.run_path(str(pathlib.Path(__file__).with_name("test_devices.py")))
finish, free_port, start, weights = (
    _DEVICES[name] for name in ("finish", "free_port", "start", "weights")
)

SETS = """[a]
splits = ["train"]
templates = ["bottom"]
solver = { substeps = 8, contact_updates = 1 }
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory, write_mocap):
    """Motions, a configuration and the digest of the undisturbed dataset."""
    actions = [("train", f"part {k}", 0.2 * k, 5 + k) for k in range(6)]
    folder = write_mocap(tmp_path_factory.mktemp("kills"), 60, actions)
    (folder / "sets.toml").write_text(SETS)
    done = build(folder, "plain")
    assert done.wait(200) == 0
    return folder, dataset_digest(folder / "plain")


def build(folder, out, *more):
    words = ["dataset", "build", f"{folder}/sets.toml#a", "--out", f"{folder}/{out}"]
    run = "import sys; from physxnet_jax.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", run, *words, "--mocap", str(folder), *more]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.fixture(scope="module")
def tests_to_judge(place, write_mocap):
    """A small dataset of test actions."""
    folder = place[0] / "tests"
    folder.mkdir()
    write_mocap(folder, 60, [("test", f"judged {k}", 0.1 * k, 6) for k in range(3)])
    (folder / "sets.toml").write_text(SETS.replace("train", "test"))
    assert build(folder, "judged").wait(300) == 0
    return folder / "judged"


def stored(folder, out):
    return len(list((folder / out).glob("*/bottom/zarr.json")))


@pytest.mark.nightly
def test_a_killed_build_goes_on_to_the_same_bytes(place):
    folder, digest = place
    process = build(folder, "one")
    while not stored(folder, "one"):
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert stored(folder, "one") < 6, "it was killed in the middle"
    assert build(folder, "one").wait(200) == 0
    assert dataset_digest(folder / "one") == digest


def workers_of():
    """Processes that run jobs."""
    found = []
    for path in pathlib.Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if b"ray::_attempt" in path.read_bytes():
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="finds workers in /proc")
def test_a_build_on_ray_killed_five_times_has_the_same_bytes(place):
    pytest.importorskip("ray", reason="Ray isn't installed: pip install 'physxnet-jax[cluster]'")
    folder, digest = place
    chance = random.Random(1)
    victims = ["driver", "worker", "worker", "driver", "worker"]
    process = build(folder, "ray", "--ray")
    while victims:
        time.sleep(chance.uniform(3.0, 12.0))
        # On a slow machine workers are long in coming.
        while victims[0] == "worker" and process.poll() is None and not workers_of():
            time.sleep(0.1)
        if process.poll() is not None:
            # It was done: all of it again.
            for path in (folder / "ray").glob("*/bottom/zarr.json"):
                path.unlink()
            process = build(folder, "ray", "--ray")
            continue
        if victims[0] == "worker":
            with contextlib.suppress(ProcessLookupError, IndexError):
                os.kill(chance.choice(workers_of()), signal.SIGKILL)
                victims.pop(0)
        else:
            victims.pop(0)
            process.kill()
            process.wait()
            process = build(folder, "ray", "--ray")
    process.wait(300)
    assert build(folder, "ray", "--ray").wait(300) == 0
    assert dataset_digest(folder / "ray") == digest


@pytest.mark.nightly
def test_training_killed_five_times_has_the_same_weights(tmp_path):
    finish(start(tmp_path / "plain", steps=400, epochs=80))
    chance = random.Random(2)
    for _ in range(5):
        process = start(tmp_path / "killed", steps=400, epochs=80)
        time.sleep(chance.uniform(8.0, 20.0))
        process.kill()
        process.communicate()
    finish(start(tmp_path / "killed", steps=400, epochs=80))
    np.testing.assert_array_equal(weights(tmp_path / "killed"), weights(tmp_path / "plain"))


@pytest.mark.nightly
def test_a_lost_training_process_ends_the_run_which_resumes(tmp_path):
    def both(steps):
        port = free_port()
        return [start(tmp_path / "killed", number=str(k), port=port, steps=steps) for k in range(2)]

    first, second = both(40)
    checkpoints = tmp_path / "killed/checkpoints"
    # Names of unfinished ones are no numbers.
    while not (checkpoints.is_dir() and any(p.name.isdigit() for p in checkpoints.iterdir())):
        assert first.poll() is None, first.communicate()[0][-2000:]
        time.sleep(0.02)
    second.kill()
    second.communicate()
    out, _ = first.communicate(timeout=150)
    assert first.returncode != 0 and "another process of this run has ended" in out, out[-6000:]
    assert not (tmp_path / "killed/weights.npz").exists()
    finish(*both(20), start(tmp_path / "plain"))
    assert np.abs(weights(tmp_path / "killed") - weights(tmp_path / "plain")).max() < 1e-5


# Words of a command, and its outputs; a name with a star stands for several files.
LONG = {
    "dress": (
        "dress walk --wear bottom --weights nano --substeps 4 --frames 96 --fps 30 -o out.npz",
        ("out.npz",),
    ),
    "dress to OBJ": (
        "dress walk --wear bottom --method network --weights nano --frames 48 -o out.obj",
        ("*.obj",),
    ),
    "simulate": (
        "simulate walk --wear bottom --accuracy draft --frames 40 -o out.pc2",
        ("*.pc2", "*.obj"),
    ),
    "adapt": (
        "adapt bottom --weights nano --frames 40 --steps 250 -o mine",
        ("mine/*",),
    ),
    "evaluate": (
        "evaluate lbs nano nano+relax+push draft --data {data} --out out.json",
        ("out*",),
    ),
    "calibrate": ("calibrate", ("cache/physxnet_jax/calibration.json",)),
}
# Keys of JSON files whose values are measured times, or follow from them.
TIMES = ("ms_per_frame", "times", "seconds", "date", "machine")
# Kills itself at the n-th file that is put in place: just before that, or just after.
IN_A_WRITE = """
import os, pathlib, signal, sys
left, after, count = int(sys.argv.pop(1)), sys.argv.pop(1) == "after", sys.argv.pop(1)
if left == 0:
    import atexit
    atexit.register(lambda: pathlib.Path(count).write_text(str(-left)))
replace = pathlib.Path.replace
def dying(self, target):
    global left
    left -= 1
    if left == 0 and not after:
        os.kill(os.getpid(), signal.SIGKILL)
    done = replace(self, target)
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return done
pathlib.Path.replace = dying
"""
# Started in the background, a process would ignore Ctrl-C.
MAIN = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from physxnet_jax.cli import main
sys.exit(main())
"""


def started(folder, words, before="", *more):
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-c", before + MAIN, *more, *words.split()]
    environment = dict(os.environ)
    if words == "calibrate":
        # Times in the folder, programs where those of all commands are.
        programs = str(compilation_cache_folder())
        environment |= {
            "XDG_CACHE_HOME": str(folder / "cache"),
            "JAX_COMPILATION_CACHE_DIR": programs,
        }
    return subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def without_times(value):
    """A JSON value whose times are replaced by what they are of."""
    if isinstance(value, list):
        return [without_times(v) for v in value]
    if not isinstance(value, dict):
        return value
    return {k: shape_of(v) if k in TIMES else without_times(v) for k, v in value.items()}


def shape_of(value):
    """A JSON value with the kinds of its numbers and words in their place."""
    if isinstance(value, dict):
        return {k: shape_of(v) for k, v in value.items()}
    return type(value).__name__


def contents(path):
    """What a file holds, measured times apart."""
    if path.suffix == ".json":
        return without_times(json.loads(path.read_text()))
    # Tables and charts show times.
    return None if path.suffix in (".md", ".png") else path.read_bytes()


def results(folder, patterns):
    found = sorted({p for name in patterns for p in folder.glob(name) if p.is_file()})
    return {str(p.relative_to(folder)): contents(p) for p in found}


def files_of(folder):
    # Compiled programs stay in the cache.
    found = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    return {n for n in found if not n.startswith("cache/") or "calibration" in n}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, request):
    """The words of a command, what it leaves, its time [s], and the files that it puts in place."""
    known = {}

    def run(name):
        if name not in known:
            words, patterns = LONG[name]
            if "{data}" in words:
                words = words.format(data=request.getfixturevalue("tests_to_judge"))
            count = tmp_path_factory.mktemp("counts") / "writes"
            for _ in range(2):
                # The second time programs are compiled, as in the runs that are killed.
                folder = tmp_path_factory.mktemp("undisturbed")
                begun = time.monotonic()
                process = started(folder, words, IN_A_WRITE, "0", "before", str(count))
                assert process.wait(600) == 0
                seconds = time.monotonic() - begun
            assert files_of(folder) == set(results(folder, patterns))
            writes = int(count.read_text())
            known[name] = words, results(folder, patterns), seconds, writes
        return known[name]

    return run


def killed(name, folder, undisturbed, seed):
    """Kills a command at a moment, by a signal or in a write, and lets it run again."""
    patterns = LONG[name][1]
    words, expected, seconds, writes = undisturbed(name)
    chance = random.Random(f"{name} {seed}")
    kind = chance.choice(["KILL", "TERM", "INT", "before", "after"])
    if kind in ("before", "after"):
        process = started(folder, words, IN_A_WRITE, str(chance.randint(1, writes)), kind, "")
        process.wait(600)
    else:
        process = started(folder, words)
        time.sleep(chance.uniform(0.3, 1.0) * seconds)
        process.send_signal(getattr(signal, f"SIG{kind}"))
        process.wait(600)
    if kind in ("TERM", "INT"):
        # It had the time to tidy up.
        left = {n for n in files_of(folder) if not n.partition("/")[0].endswith(".unfinished")}
        assert left <= set(expected), (kind, left)
    assert started(folder, words).wait(600) == 0
    assert results(folder, patterns) == expected, (kind, process.returncode)
    assert files_of(folder) == set(expected), "something was left lying"
    return process.returncode


@pytest.mark.release
def test_a_command_killed_once_gives_the_same_bytes(undisturbed, tmp_path):
    assert killed("dress", tmp_path / "0", undisturbed, 0) != 0, "it was killed in time"


@pytest.mark.nightly
@pytest.mark.parametrize("name", LONG)
def test_commands_killed_anywhere_give_the_same_bytes(name, undisturbed, tmp_path, promise):
    ended = [killed(name, tmp_path / str(k), undisturbed, k) for k in range(8)]
    in_time = sum(code != 0 for code in ended)
    promise("killed anywhere, the same bytes", name, in_time, "kills in time", tries=len(ended))
    assert in_time >= len(ended) // 2
