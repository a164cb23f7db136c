"""Examples, the notebook and the documents' code run as they stand."""

import json
import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PAGES = [
    p
    for p in sorted((ROOT / "docs").rglob("*.md"))
    if "```python" in p.read_text() and "_build" not in p.parts
]

pytestmark = pytest.mark.release


def test_examples_are_numbered_without_gaps():
    assert [p.name[:2] for p in EXAMPLES] == [f"{k:02d}" for k in range(8)]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_examples_run(path, tmp_path):
    """As a user runs it: a process of its own, in a folder of its own."""
    done = subprocess.run(
        [sys.executable, str(path)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert f"python examples/{path.name}" in path.read_text()
    assert re.search(r"\d+ s in all", done.stdout)
    (picture,) = re.findall(r"wrote (out/\w+\.png)", done.stdout)
    assert (tmp_path / picture).stat().st_size > 10_000
    if path.name.startswith("04"):
        found = float(re.search(r"found ([\d.]+) rad", done.stdout).group(1))
        assert found == pytest.approx(0.6, abs=0.02)
    if path.name.startswith("06"):
        found = float(re.search(r"found ([\d.]+) times", done.stdout).group(1))
        assert found == pytest.approx(3.0, rel=0.05)
    if path.name.startswith("05"):
        before, after, worn = (float(x) for x in re.findall(r"([\d.]+) mm", done.stdout))
        assert after < 0.7 * before and worn < 1.05 * after


def test_notebook_runs_and_contains_no_output(capsys):
    nb = json.loads((ROOT / "examples/differentiable_layer.ipynb").read_text())
    assert nb["nbformat"] == 4 and len({c["id"] for c in nb["cells"]}) == len(nb["cells"])
    there = {}
    for cell in nb["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
            exec("".join(cell["source"]), there)
    assert there["by_gradient"] == pytest.approx(there["by_difference"], rel=0.05, abs=0.005)
    assert "True\n" in capsys.readouterr().out


@pytest.mark.sampled(3)
@pytest.mark.parametrize("path", PAGES, ids=lambda p: p.stem)
def test_code_of_each_page_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    there = {}
    for code in re.findall(r"```python\n(.*?)```", path.read_text(), re.S):
        exec(code, there)


def test_documentation_builds_without_warnings(tmp_path):
    """Sphinx makes them without a warning: every reference is found, every page listed."""
    pytest.importorskip("sphinx_book_theme")
    words = ["-m", "sphinx", "-W", "-q", "-b", "html", str(ROOT / "docs"), str(tmp_path)]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    index = (tmp_path / "index.html").read_text()
    for page in ROOT.glob("docs/*.md"):
        assert page.stem == "index" or f"{page.stem}.html" in index, page.name
    api = re.sub(r"<[^>]*>", "", (tmp_path / "api.html").read_text())
    assert "physxnet_jax.clothe(" in api and "frames joints 4" in api
