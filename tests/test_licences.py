"""The page of licences lists what is installed and what is in the package."""

import pathlib
import re
import runpy

import pytest

ROOT = pathlib.Path(__file__).parents[1]
MADE = runpy.run_path(str(ROOT / "docs/licences.py"))
PAGE = MADE["PAGE"].read_text()


def rows(columns):
    found = re.findall(r"^\|" + r"([^|\n]*)\|" * columns + "$", PAGE, re.M)
    return [tuple(x.strip() for x in row) for row in found]


def test_every_locked_package_is_listed_with_its_version_and_who_needs_it():
    pytest.importorskip("uv", reason="the lock file is read by uv")
    listed = {name: (version, needed.split(", ")) for name, version, _, needed in rows(4)[2:]}
    assert listed == {name: tuple(value) for name, value in MADE["packages"]().items()}
    # A licence is missing for packages of other systems alone.
    missing = {name for name, _, licence, _ in rows(4)[2:] if licence == "—"}
    assert missing <= {"colorama", "nest-asyncio", "pyobjc-core", "pyobjc-framework-cocoa"}


def test_packaged_data_have_the_listed_checksums():
    listed = {name: digest.strip("`") for name, digest in rows(2)[2:]}
    assert listed == MADE["data_files"]()
    assert "io/assets/model-viewer.min.js" in listed and "body/assets/makehuman_cc0.npz" in listed


def test_licences_of_installed_packages_are_found():
    assert MADE["licence_of"]("numpy") not in ("—", "none stated")
    assert MADE["licence_of"]("no-such-package") == "—"
