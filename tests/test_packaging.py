"""The wheel, in an environment that has nothing else."""

import json
import pathlib
import subprocess
import sys
import zipfile

import numpy as np
import pytest

import physxnet_jax

ROOT = pathlib.Path(__file__).parents[1]
UV = pathlib.Path(sys.executable).parent / "uv"
# What asks for each extra.
EXTRAS = {
    "usd": "from physxnet_jax.io import check_output; check_output('a.usdc')",
    "gltf": "from physxnet_jax.io import check_output; check_output('a.glb')",
    "render": "from physxnet_jax.viewer import check_preview; check_preview('a.mp4')",
    "mesh": (
        "from physxnet_jax.garment._decimate import decimate;"
        " from physxnet_jax.garment import template; decimate(template('bottom').mesh, 0.05)"
    ),
    "export": (
        "import physxnet_jax as px; from physxnet_jax.dressing import export_dresser;"
        " export_dresser('dresser', px.make_dresser(['bottom'], inference=px.Inference(weights='nano')))"
    ),
    "viewer": (
        "from physxnet_jax.viewer._guard import Guard;"
        " from physxnet_jax.viewer._server import start_server;"
        " start_server('127.0.0.1', 8400, Guard('127.0.0.1', lambda _: None))"
    ),
}

pytestmark = pytest.mark.release


def run(*words, **more):
    done = subprocess.run(
        [str(w) for w in words], capture_output=True, text=True, timeout=900, **more
    )
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("dist")
    run(UV, "build", "--quiet", "--wheel", "--out-dir", out, ROOT)
    (path,) = out.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory):
    """The interpreter of a fresh environment with the wheel, without any extra."""
    folder = tmp_path_factory.mktemp("empty") / "env"
    run(UV, "venv", "--quiet", "--python", sys.executable, folder)
    path = folder / "bin" / "python"
    run(UV, "pip", "install", "--quiet", "--python", path, wheel)
    return path


def test_wheel_contains_only_the_package_with_weights_types_and_licence(wheel):
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
    assert "physxnet_jax/py.typed" in names
    assert any(n.endswith("weights/base/weights.safetensors") for n in names)
    assert any(n.endswith("licenses/LICENSE") for n in names)
    roots = {n.split("/")[0] for n in names}
    assert roots == {"physxnet_jax", f"physxnet_jax-{physxnet_jax.__version__}.dist-info"}
    assert wheel.stat().st_size < 30e6


def test_command_works_without_optional_dependencies(python, tmp_path):
    """By its own network, and packaged weights."""
    words = ["dress", "walk", "--wear", "bottom", "--frames", "2"]
    out = run(python.parent / "physxnet", *words, "-o", tmp_path / "a.npz", cwd=tmp_path)
    assert "wrote" in out
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        cloth = file["bottom_positions"]
    assert len(cloth) == 2 and np.isfinite(cloth).all()


def test_missing_extras_are_named_and_sufficient_once_installed(python, wheel, tmp_path):
    scripts = {
        extra: f"try:\n    {call}\nexcept ImportError as e:\n    print('needs', e)\n"
        for extra, call in EXTRAS.items()
    }
    asked = run(python, "-c", "print('-')\n".join(scripts.values()), cwd=tmp_path).split("-\n")
    for extra, out in zip(EXTRAS, asked, strict=True):
        assert f"physxnet-jax[{extra}]" in out, extra
    for extra, script in scripts.items():
        run(UV, "pip", "install", "--quiet", "--python", python, f"{wheel}[{extra}]")
        assert "needs" not in run(python, "-c", script, cwd=tmp_path), extra


TENSORBOARD = (
    "import pathlib; from physxnet_jax.training._monitor import TensorBoardLogger\n"
    "b = TensorBoardLogger(pathlib.Path('run')); b.write({'loss': 1.0}, 0); b.close()\n"
    "print(len(list(pathlib.Path('run').rglob('events.*'))))"
)


@pytest.mark.nightly
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
@pytest.mark.parametrize("extra", ["wheel", "sdist", "train", *EXTRAS])
def test_base_and_each_extra_alone_work_on_each_python(version, extra, wheel, tmp_path):
    """In an environment of its own."""
    if subprocess.run([UV, "python", "find", "--offline", version], capture_output=True).returncode:
        pytest.skip(f"Python {version} isn't installed")
    package = f"{wheel}[{extra}]" if extra not in ("wheel", "sdist") else wheel
    if extra == "sdist":
        run(UV, "build", "--quiet", "--sdist", "--out-dir", tmp_path, ROOT)
        (package,) = tmp_path.glob("*.tar.gz")
    python = tmp_path / "env" / "bin" / "python"
    run(UV, "venv", "--quiet", "--offline", "--python", version, tmp_path / "env")
    run(UV, "pip", "install", "--quiet", "--python", python, package)
    assert run(python, "--version").split()[1].startswith(version)
    if extra in EXTRAS:
        run(python, "-c", EXTRAS[extra], cwd=tmp_path)
    elif extra == "train":
        assert run(python, "-c", TENSORBOARD, cwd=tmp_path).split()[-1] == "1"
    else:
        test_command_works_without_optional_dependencies(python, tmp_path)


def test_tensorboard_events_are_written_only_with_the_train_extra(python, wheel, tmp_path):
    """Without it training goes on, unwatched."""
    assert run(python, "-c", TENSORBOARD, cwd=tmp_path).split()[-1] == "0"
    run(UV, "pip", "install", "--quiet", "--python", python, f"{wheel}[train]")
    assert run(python, "-c", TENSORBOARD, cwd=tmp_path).split()[-1] == "1"


def test_imports_are_lazy_and_load_no_optional_library():
    script = """
import json, sys
import physxnet_jax as px
alone = sorted(sys.modules)
for name in px.__all__:
    getattr(px, name)
print(json.dumps([alone, sorted(sys.modules), dir(px)]))
"""
    alone, whole, names = json.loads(run(sys.executable, "-c", script))
    assert not {"jax", "numpy", "flax", "orbax"} & set(alone)
    assert "jax" in whole and "physxnet_jax.dressing" in whole
    optional = {"pxr", "pygltflib", "fast_simplification", "viser", "matplotlib", "pyvista"}
    # Not flatbuffers: jax itself looks for it.
    optional |= {"imageio", "PIL", "tensorboardX", "sphinx"}
    assert not optional & set(whole)
    assert set(physxnet_jax.__all__) <= set(names)


def test_package_table_covers_all_public_names():
    """Each public name is found, and lives where the table says."""
    public_names = {name for names in physxnet_jax._PACKAGES.values() for name in names}
    assert public_names == set(physxnet_jax.__all__) - {"__version__"}
    for name in public_names:
        assert getattr(physxnet_jax, name) is not None
    assert physxnet_jax.motion.load_motion is physxnet_jax.load_motion
    with pytest.raises(AttributeError, match="no attribute 'undress'"):
        physxnet_jax.undress  # noqa: B018
