"""The README tells the truth: its commands exist, its table is the measured one."""

import json
import pathlib
import re
import runpy

import pytest

from physxnet_jax.cli import main
from physxnet_jax.cli._main import _COMMANDS
from physxnet_jax.evaluation import ActionError
from physxnet_jax.garment import tailor

ROOT = pathlib.Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()


def test_readme_commands_targets_and_links_exist():
    targets = re.findall(r"^make (\w+)", TEXT, re.M)
    makefile = (ROOT / "Makefile").read_text()
    assert targets and all(f"\n{t}:" in makefile for t in targets)
    for name in re.findall(r"python (experiments/\w+\.py)", TEXT):
        assert (ROOT / name).is_file()
    for path in re.findall(r"\]\(([^)h][^)]*)\)", TEXT):
        assert (ROOT / path).is_file(), path
    words = set(re.findall(r"physxnet (\w+)", TEXT))
    assert words and words <= set(_COMMANDS)
    with pytest.raises(SystemExit):
        main(["undress"])


def test_readme_table_matches_the_measurements():
    rows = json.loads((ROOT / "experiments/results/test_errors.json").read_text())
    made = runpy.run_path(str(ROOT / "experiments/reproduce.py"))
    table = made["short_table"]([ActionError(**r) for r in rows])
    assert "| `base` |" in table and table.strip() in TEXT


@pytest.mark.release
def test_readme_python_examples_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", TEXT, re.S)
    assert len(blocks) == 1
    there = {}
    for code in blocks:
        short = code.replace("rotations,", "rotations[:3],")
        exec(short.replace("root,", "root[:3],"), there)
    assert there["trousers"].shape == (3, template_size("trousers"), 3)


def template_size(kind):
    return tailor(kind).num_vertices


def test_readme_is_short():
    assert len(TEXT.splitlines()) <= 100
