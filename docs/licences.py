"""Writes docs/licences.md: what an installation consists of, and under which licences.

Command: python docs/licences.py
Needs:   all extras (`make .venv/.ready EXTRAS=cluster`), uv.
Result:  docs/licences.md; tests/test_licences.py compares packages and checksums.
"""

import hashlib
import importlib.metadata
import pathlib
import re
import subprocess
import sys
import tomllib

from physxnet_jax.files import atomic_write

ROOT = pathlib.Path(__file__).parents[1]
PACKAGE = ROOT / "src/physxnet_jax"
PAGE = ROOT / "docs/licences.md"
# For those who work on the package, not for those who use it.
_OURS = ("dev", "docs")


def locked(*extras: str) -> dict[str, str]:
    """Versions of the packages that the base or some extras install, from uv.lock."""
    words = [pathlib.Path(sys.executable).parent / "uv", "export", "--frozen", "--no-emit-project"]
    # A home that can't be written has no cache.
    words += ["--no-cache"]
    words += ["--no-hashes", "--no-header", "--no-annotate", "--quiet"]
    for extra in extras:
        words += ["--extra", extra]
    text = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return dict(re.findall(r"^([\w.-]+)==([^ ;\n]+)", text, re.M))


def licence_of(name: str) -> str:
    """The licence that an installed package states; a dash if it isn't installed here."""
    try:
        info = importlib.metadata.metadata(name)
    except importlib.metadata.PackageNotFoundError:
        return "—"
    named = (*info.get_all("License-Expression", []), *info.get_all("License", []), "")
    stated = str(next(filter(None, named), ""))
    kinds = [c.rpartition(" :: ")[2] for c in info.get_all("Classifier", []) if "License ::" in c]
    if not stated or "\n" in stated.strip() or len(stated) > 60:
        stated = ", ".join(kinds) or stated.strip().partition("\n")[0][:60]
    return stated or "none stated"


def packages() -> dict[str, tuple[str, list[str]]]:
    """Version of each package that users install, and which extras need it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    base = locked()
    found = {name: (version, ["base"]) for name, version in base.items()}
    for extra in project["optional-dependencies"]:
        if extra in _OURS:
            continue
        for name, version in locked(extra).items():
            if name not in base:
                found.setdefault(name, (version, []))[1].append(extra)
    return dict(sorted(found.items()))


def data_files() -> dict[str, str]:
    """SHA-256 of every file in the package that isn't code."""
    paths = (
        p for p in sorted(PACKAGE.rglob("*")) if p.is_file() and p.suffix not in (".py", ".pyc")
    )
    return {str(p.relative_to(PACKAGE)): hashlib.sha256(p.read_bytes()).hexdigest() for p in paths}


def page() -> str:
    """The page."""
    lines = ["# Licences and contents", "", "Written by `python docs/licences.py` from uv.lock."]
    lines += [
        "",
        "physxnet_jax is MIT. It imports the packages below; none of them is copied into it. The"
        " `render` extra installs imageio-ffmpeg, whose wheel carries a build of ffmpeg under the"
        " GPL: it is started as a process of its own to write videos, and nothing is linked to it."
        " Without that extra there is no ffmpeg.",
        "",
        "`make bom` writes a bill of materials (CycloneDX 1.5) of the locked versions.",
        "",
        "| package | locked version | licence as stated | needed by |",
        "|---|---|---|---|",
    ]
    for name, (version, extras) in packages().items():
        lines.append(f"| {name} | {version} | {licence_of(name)} | {', '.join(extras)} |")
    lines += ["", "## Packaged data", "", "| file | SHA-256 |", "|---|---|"]
    lines += [f"| {name} | `{digest}` |" for name, digest in data_files().items()]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Writes it."""
    with atomic_write(PAGE) as part:
        part.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
