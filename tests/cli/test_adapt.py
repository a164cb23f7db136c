"""`physxnet adapt`: weights that `dress` wears, and what is refused."""

import json

import pytest

from physxnet_jax.cli import main
from physxnet_jax.models import read_card


@pytest.mark.release
def test_adapted_weights_are_written_and_worn(tmp_path, capsys):
    out = tmp_path / "trousers"
    options = ["--weights", "nano", "--frames", "6", "--steps", "2", "--fabric", "wool"]
    assert main(["adapt", "bottom", *options, "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["garment"] == "bottom:fabric=wool" and found["from"] == "nano"
    assert found["loss"][1] <= found["loss"][0] and found["rmse_mm"] is None
    card = read_card(out)
    assert card["name"] == "trousers" and card["adapted"]["steps"] == found["steps"]
    assert [p.name for p in tmp_path.iterdir()] == ["trousers"], "nothing unfinished is left"
    clip = tmp_path / "walk.npz"
    wear = ["--wear", "bottom", "--method", "network", "--weights", str(out), "--frames", "2"]
    assert main(["dress", "walk", *wear, "-o", str(clip), "--quiet"]) == 0
    assert clip.is_file()


def test_what_cannot_be_adapted_ends_with_a_sentence(tmp_path, capsys):
    taken = tmp_path / "file"
    taken.write_text("mine")
    assert main(["adapt", "bottom", "-o", str(taken)]) == 2
    assert "is a file" in capsys.readouterr().err and taken.read_text() == "mine"
    assert main(["adapt", "bottom", "--steps", "0", "-o", str(tmp_path / "w")]) == 2
    assert "--steps is 0" in capsys.readouterr().err
    assert main(["adapt", "bottom", "--weights", "none", "-o", str(tmp_path / "w")]) == 2
    assert "No weights 'none'" in capsys.readouterr().err
    assert not (tmp_path / "w").exists()
