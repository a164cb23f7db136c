"""Builds the extension as a zip for Blender: Preferences, Get Extensions, Install from Disk.

Command: python integrations/blender/build.py
Result:  dist/physxnet_blender-VERSION.zip
"""

import pathlib
import tomllib
import zipfile

HERE = pathlib.Path(__file__).parent
SOURCE = HERE / "physxnet"


def build(folder: pathlib.Path) -> pathlib.Path:
    """Writes the zip into a folder and returns its path."""
    manifest = tomllib.loads((SOURCE / "blender_manifest.toml").read_text())
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"physxnet_blender-{manifest['version']}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(SOURCE.iterdir()):
            if file.suffix in (".py", ".toml"):
                # A fixed date: equal sources give equal bytes.
                info = zipfile.ZipInfo(file.name, (2020, 1, 1, 0, 0, 0))
                info.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(info, file.read_bytes())
    return path


if __name__ == "__main__":
    print(build(HERE.parents[1] / "dist"))
