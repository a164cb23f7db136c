"""What is printed carries no control characters."""

import io
import os
import subprocess
import sys

import numpy as np
import pytest
from rich.table import Table

from physxnet_jax.cli import main
from physxnet_jax.cli._console import PlainConsole
from physxnet_jax.errors import MotionError, PhysXNetError, visible

NASTY = "Arm\x1bc\x1b[2J\x07\r\x00\x7f\x9b31m\u202egnp"

# Without what no reader takes for text.
TEXT = NASTY.replace("\r", "").replace("\0", "")


def has_controls(text):
    return any(
        (ord(c) < 32 and c not in "\n\t") or 127 <= ord(c) < 160 or 0x202A <= ord(c) < 0x202F
        for c in text
    )


def test_text_of_files_is_made_visible():
    assert has_controls(NASTY) and not has_controls(visible(NASTY))
    assert visible("plain, äöü 服 \n\t") == "plain, äöü 服 \n\t"
    for error in (PhysXNetError(NASTY), MotionError.at(NASTY, 1, NASTY, NASTY)):
        assert not has_controls(str(error)) and "\\x1bc" in str(error)


def test_consoles_show_control_characters():
    file = io.StringIO()
    console = PlainConsole(file=file, markup=False, width=200)
    table = Table(NASTY)
    table.add_row(NASTY)
    console.print(NASTY, table, f"a {NASTY}", style="red")
    assert not has_controls(file.getvalue()) and file.getvalue().count("\\x1bc") == 4


@pytest.mark.parametrize("command", ["inspect", "dress"])
def test_names_of_joints_do_not_reset_the_terminal(tmp_path, capsys, command):
    path = tmp_path / "a.bvh"
    path.write_text(
        f"HIERARCHY\nROOT Arm{chr(27)}c\n{{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation"
        " Yrotation Zrotation\nEnd Site\n{\nOFFSET 0 1 0\n}\n}\nMOTION\nFrames: 1\n"
        "Frame Time: 0.033\n0 0 0\n"
    )
    assert main([command, str(path)]) != 0
    said = capsys.readouterr()
    assert "Arm" in said.out + said.err
    assert not has_controls(said.out) and not has_controls(said.err)


@pytest.mark.nightly
def test_names_of_meshes_do_not_reset_the_terminal(tmp_path, capsys):
    path = tmp_path / "a.obj"
    x = np.random.default_rng(0).normal(size=(9, 3))
    lines = [f"o {TEXT}", *(f"v {a} {b} {c}" for a, b, c in x)]
    path.write_text("\n".join([*lines, "f 1 2 3", "f 4 5 6", "f 7 8 9"]))
    assert main(["inspect", str(path)]) != 0
    said = capsys.readouterr()
    assert said.out + said.err and not has_controls(said.out) and not has_controls(said.err)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
@pytest.mark.parametrize("words", ["clips", "clips --json", "--help"])
def test_a_closed_pipe_has_an_exit_code_of_its_own(words):
    run = "import sys; from physxnet_jax.cli import main; sys.exit(main())"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-c", run, *words.split()], stdout=write, stderr=subprocess.PIPE
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b"")


def test_an_option_that_is_given_twice_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["dress", "walk", "--wear", "shirt", "--wear", "trousers"])
    assert ended.value.code == 2 and "--wear is given twice" in capsys.readouterr().err
