"""`physxnet tailor` writes what other programs can read."""

import json

import numpy as np
import pytest

from physxnet_jax.cli import main
from physxnet_jax.garment import KINDS, load_garment, tailor
from physxnet_jax.io import read_mesh


@pytest.mark.parametrize("suffix", [".obj", pytest.param(".glb", marks=pytest.mark.release)])
def test_written_garments_are_read_where_they_were(tmp_path, capsys, suffix):
    out = tmp_path / f"s{suffix}"
    assert main(["tailor", "shorts:ease=0.1,fabric=denim", "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "shorts" and found["measures"]["ease"] == 0.1
    assert found["fabric"]["density"] == pytest.approx(0.4)
    assert json.loads((tmp_path / "s.json").read_text())["held"] == found["held"]
    made = tailor("shorts", ease=0.1, fabric="denim")
    read = read_mesh(out)
    np.testing.assert_allclose(
        np.sort(read.vertices, axis=0), np.sort(made.mesh.vertices, axis=0), atol=1e-5
    )
    assert read.uv is not None and np.ptp(read.uv, axis=0).max() > 0.5
    again, report = load_garment(out)
    assert (report.unit, again.template) == ("m", "bottom")


def test_unknown_kinds_are_refused_and_kinds_are_listed(tmp_path, capsys):
    assert main(["tailor", "coat.obj", "-o", str(tmp_path / "a.obj")]) == 2
    assert "there are tee" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert main(["clips"]) == 0
    words = capsys.readouterr().out.replace("\n", " ")
    assert all(k in words for k in KINDS)
