"""The paper's experiment: every number and figure of docs/reproduction.md.

Command: python experiments/reproduce.py (the tables alone, from the results that are stored), or
         python experiments/reproduce.py --data runs/clothes/default
         python experiments/reproduce.py --fitted --data runs/ours
         python experiments/reproduce.py --fitted --data runs/blender --train-data runs/blender
         --methods lbs nearest mlp runs/blender-22 paper runs/paper-blender draft standard
Cost:    about an hour on two cores for the clothes (simulator, guided simulation and visible skin
         take most of it), half an hour for the fitted garments; goes on where it was stopped.
Result:  experiments/results/test_errors.json (clothes with ease) and fitted_errors.json (the
         garments of the paper's protocol), each with .md, _vertices.png and _texels.png;
         datasets.json; the tables between the marks of docs/reproduction.md,
         docs/accuracy-cost.md, docs/stability.md and README.md; the measured table in the cards
         of the packaged weights; the errors by which `physxnet dress --budget-ms` chooses.
         Datasets are built by `physxnet dataset build` from experiments/datasets.toml, weights
         trained by `physxnet train` from experiments/training.toml.
"""

import argparse
import json
import pathlib
import re
import statistics
from collections.abc import Iterable

from physxnet_jax.cli import main as physxnet
from physxnet_jax.data import (
    dataset_digest,
    is_trainable,
    list_sequences,
    read_sequence,
    read_times,
)
from physxnet_jax.evaluation import ActionError, action_name, means, summary_table
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.viewer import write_error_report

ROOT = pathlib.Path(__file__).parents[1]
RESULTS = ROOT / "experiments/results"
WEIGHTS = ROOT / "src/physxnet_jax/models/weights"
# Rows of clothes with ease, and of the fitted garments that the paper's network learned from.
CLOTHES, FITTED = RESULTS / "test_errors.json", RESULTS / "fitted_errors.json"
METHODS = {
    CLOTHES: (
        *("lbs", "nano+relax+push", "small+relax+push", "base+relax+push"),
        *("base+guided", "perturbed"),
    ),
    FITTED: ("lbs", "nearest", "mlp", "paper", "paper+push", "draft", "perturbed"),
}
# What README.md shows of them.
SHORT = {
    "lbs": "skinning alone",
    "base+relax+push": "`base`",
    "base+guided": "`base`, guided (the default)",
    "perturbed": "the simulation again, moved by 1e-6 m",
}
# Profiles that `--budget-ms` and `--max-error-mm` choose from. `standard` is as far from itself as
# two of its runs part.
LADDER = {
    **{m: m for m in ("lbs", "nano+relax+push", "base+relax+push", "base+guided")},
    "perturbed": "standard",
}
# Whose squared errors are shown action by action.
EACH = {
    CLOTHES: ("lbs", "base+relax+push", "base+guided", "perturbed"),
    FITTED: ("lbs", "paper", "paper-blender"),
}
NETWORKS = {CLOTHES: ("base+relax+push", "base+guided"), FITTED: ("paper", "paper-blender")}
# Rows of fitted_errors.md that the page leaves out.
LEFT_OUT = ("paper+push", "blender-22+push")
# The paper's order.
ACTIONS = (
    *("jump", "walking", "moon walk", "chinese dance", "punch", "balancing", "ballet"),
    *("stretch arms", "salsa dance", "jogging", "side step", "strong gesture"),
)
SETS = {
    "ours": "fitted garments, protocol",
    "blender": "the same, Blender",
    "default": "shirt, trousers, A-line dress; protocol",
    "default_extra": "the same, extra actions",
    "default_mixed": "the same, legs with other upper bodies, wider",
    "default_left_out": "the same, what the protocol leaves out",
    "variants": "36 outfits, training and extra actions",
    "variants_mixed": "the same, legs with other upper bodies, wider",
    "variants_left_out": "the same, what the protocol leaves out",
    "held_out": "12 outfits that no network has seen, test actions",
}
# Those from which single decoders learned on, in docs/networks.md.
SETS_ALONE = {
    f"{garment}{motion}": f"{what}, {how}"
    for garment, what in {
        "dress": "A-line dress",
        "dresses": "twelve dresses and skirts",
        "bottom": "trousers",
        "bottoms": "twelve trousers and shorts",
        "top": "shirt",
        "tops": "twelve shirts and tees",
    }.items()
    for motion, how in {
        "": "training and extra actions",
        "_mixed": "legs with other upper bodies, wider",
        "_left_out": "what the protocol leaves out",
        "_still": "people who stand almost still",
    }.items()
}
# The promise under which tests/evaluation/test_stress_controls.py records.
FAULTY = "a case of stress breaks with a fault"
SOFT = ("moon walk", "balancing", "walking")
ABRUPT = ("strong gesture", "jump", "punch")
COPIED = (
    *("oracle", "accuracy_cost", "peers", "engines", "training"),
    *("blender_import", "blender_extension", "layers", "adapt", "unseen", "laptop"),
    *("losses", "guided", "standing", "history", "memory", "fine_garments"),
)
DOCUMENTS = (
    *("docs/reproduction.md", "docs/accuracy-cost.md", "docs/garments.md"),
    "docs/networks.md",
    *("docs/stability.md", "docs/blender.md", "docs/reliability.md", "README.md"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", action="append", default=[], help="datasets; none: tables alone")
    parser.add_argument("--fitted", action="store_true", help="the data are fitted garments")
    parser.add_argument("--train-data", default="runs/ours", help="of nearest and mlp")
    parser.add_argument("--methods", nargs="+")
    words = parser.parse_args()
    out = FITTED if words.fitted else CLOTHES
    for data in words.data:
        where = ["--data", data, "--train-data", words.train_data, "--out", str(out)]
        code = physxnet(["evaluate", *(words.methods or METHODS[out]), *where])
        if code:
            raise SystemExit(code)
        note_datasets(pathlib.Path(data).parent)
    for path in (CLOTHES, FITTED):
        rows = sorted(read(path), key=lambda r: ACTIONS.index(action_name(r)))
        write_error_report(path, rows)
    blocks = tables()
    for path in (ROOT / name for name in DOCUMENTS):
        text = path.read_text()
        for name, block in blocks.items():
            mark = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.S)
            text = mark.sub(lambda m, b=block: f"{m[1]}{b.strip()}\n{m[2]}", text)
        with atomic_write(path) as part:
            part.write_text(text)
    for name in (p.name for p in WEIGHTS.iterdir()):
        note_measured(name)
    write_ladder(read(CLOTHES))


def read(path: pathlib.Path) -> list[ActionError]:
    """Rows of a result file."""
    return [ActionError(**r) for r in json.loads(path.read_text())]


def tables() -> dict[str, str]:
    """Every block of the documents by its mark."""
    clothes, fitted = read(CLOTHES), read(FITTED)
    blocks = {
        "summary": summary_table([r for r in fitted if r.method not in LEFT_OUT]),
        "clothes": clothes_table(clothes),
        "mse_clothes": squared_table(clothes, EACH[CLOTHES]),
        "mse_fitted": squared_table(fitted, EACH[FITTED]),
        "claims": claims(),
        "short": short_table(clothes),
        "datasets": dataset_table(SETS),
        "datasets_alone": dataset_table(SETS_ALONE),
        "sizes": sizes_table(),
        "stress": stress_table(),
        "reliability": reliability_table(),
        "stress_controls": controls_table(),
    }
    found = ((name, RESULTS / f"{name}.md") for name in COPIED)
    return blocks | {name: path.read_text() for name, path in found if path.is_file()}


def squared_table(rows: list[ActionError], methods: tuple[str, ...]) -> str:
    """The paper's measure: mean squared errors over vertices, action by action [mm^2].

    Methods side by side, each against the engine that its own data come from.
    """
    engines = list(dict.fromkeys(r.engine for r in rows))
    found = {
        (r.engine, r.method, r.template, action_name(r)): round(r.mse_vertices_mm2) for r in rows
    }
    columns = [(e, m) for e in engines for m in methods if any(k[:2] == (e, m) for k in found)]
    names = [m if len(engines) == 1 else f"{m} ({e})" for e, m in columns]
    lines = [f"| garment | action | {' | '.join(names)} |", "|---" * (len(names) + 2) + "|"]
    for t in TEMPLATES:
        for k, action in enumerate(ACTIONS):
            cells = (found.get((*c, t, action), "") for c in columns)
            lines.append(f"| {'' if k else t} | {action} | {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


# What `clothes_table` tells of each row besides errors: digits and value.
LOOKS = {
    "folds": (2, lambda r: r.fold_strength),
    "spectrum": (2, lambda r: r.spectrum),
    "tension": (2, lambda r: r.tension_p99 / r.tension_p99_reference),
    "jerk": (2, lambda r: r.jitter / r.jitter_reference),
    "visible skin, %": (3, lambda r: 100.0 * r.visible_skin),
    "ms a frame and garment": (1, lambda r: r.ms_per_frame),
}


def clothes_table(
    rows: list[ActionError],
    names: dict[str, str] | None = None,
    looks: tuple[str, ...] = tuple(LOOKS),
) -> str:
    """Means over the twelve actions: errors, and whether cloth looks like cloth.

    Args:
        rows: Rows of clothes.
        names: Methods to show and what to call them; all under their own names if None.
        looks: Names of `LOOKS` to show.
    """
    lines = [
        "| method | shirt, mm | trousers, mm | dress, mm | over skinning | better in |"
        f" {' | '.join(looks)} |",
        "|---" * (6 + len(looks)) + "|",
    ]
    plain = {(r.action, r.template): r.rmse_vertices_mm for r in rows if r.method == "lbs"}
    names = {r.method: r.method for r in rows} if names is None else names
    for method, label in names.items():
        mine = [r for r in rows if r.method == method]
        if not mine:
            continue
        of = [[r.rmse_vertices_mm for r in mine if r.template == t] for t in TEMPLATES]
        base = [[plain[r.action, t] for r in mine if r.template == t] for t in TEMPLATES]
        ratios = [f"{sum(a) / sum(b):.2f}" for a, b in zip(of, base, strict=True) if a]
        wins = sum(r.rmse_vertices_mm < plain[r.action, r.template] for r in mine)
        cells = [f"{statistics.fmean(x):.1f}" if x else "" for x in of]
        cells += ["", ""] if method == "lbs" else [" ".join(ratios), f"{wins} of {len(mine)}"]
        for digits, value in (LOOKS[name] for name in looks):
            cells.append(f"{statistics.fmean(map(value, mine)):.{digits}f}")
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def short_table(rows: list[ActionError]) -> str:
    """A few methods and columns of `clothes_table`."""
    return clothes_table(rows, SHORT, ("folds", "visible skin, %", "ms a frame and garment"))


def stress_table() -> str:
    """Hard cases of the simulator, with what other engines give where they can run them."""
    lines = ["| case | measured | bound | here | Blender | Newton |", "|---|---|---|---|---|---|"]
    last = ""
    for r in json.loads((RESULTS / "stress.json").read_text()):
        values = [f"{r[k]:.3g}" if k in r else "" for k in ("measured", "blender", "newton")]
        case = r["case"].replace("_", " ") if r["case"] != last else ""
        cells = [case, r["quantity"], f"{r['bound']:g}", *values]
        lines.append(f"| {' | '.join(cells)} |")
        last = r["case"]
    return "\n".join(lines)


def reliability_table() -> str:
    """What tests with PHYSXNET_RECORD have measured of promises."""
    lines = ["| promise | case | tries | failures | measured |", "|---|---|---|---|---|"]
    last = ""
    for r in json.loads((RESULTS / "reliability.json").read_text()):
        if r["promise"] == FAULTY:
            continue
        promise = r["promise"] if r["promise"] != last else ""
        figure = f"{r['figure']:.4g} {r['unit']}"
        lines.append(f"| {promise} | {r['case']} | {r['tries']} | {r['failures']} | {figure} |")
        last = r["promise"]
    return "\n".join(lines)


def controls_table() -> str:
    """What breaks in the cases of `physxnet stress` when the simulator is given a fault."""
    lines = ["| case | fault | breaks | measured |", "|---|---|---|---|"]
    for r in json.loads((RESULTS / "reliability.json").read_text()):
        if r["promise"] == FAULTY:
            name, fault = r["case"].split(": ")
            lines.append(f"| {name} | {fault} | {r['unit']} | {r['figure']:.3g} |")
    return "\n".join(lines)


def write_ladder(rows: list[ActionError]) -> None:
    """The errors by which `physxnet dress --budget-ms` chooses."""
    profiles = []
    for method, name in LADDER.items():
        found = {t: m for t in TEMPLATES if (m := means(rows, method, t, "physxnet"))}
        if len(found) == len(TEMPLATES):
            profiles.append(
                {
                    "name": name,
                    "rmse_mm": {t: round(m["rmse_vertices_mm"], 2) for t, m in found.items()},
                    "inside": {t: round(m["penetration_share"], 5) for t, m in found.items()},
                    "usual_ms": {t: float(f"{m['ms_per_frame']:.3g}") for t, m in found.items()},
                }
            )
    with atomic_write(ROOT / "src/physxnet_jax/evaluation/cost_table.json") as part:
        part.write_text(json.dumps(profiles, indent=1) + "\n")


def note_datasets(folder: pathlib.Path, names: Iterable[str] = (*SETS, *SETS_ALONE)) -> None:
    """Sizes, times and checksums of the datasets that are built."""
    path = RESULTS / "datasets.json"
    known = json.loads(path.read_text()) if path.is_file() else {}
    for name in names:
        if not (folder / name / "dataset.json").is_file():
            continue
        stored = [
            s for split in ("train", "test", "extra") for s in list_sequences(folder / name, split)
        ]
        sequences = [read_sequence(s) for s in stored]
        if not any(s.offsets for s in sequences):
            continue
        digest, size = dataset_digest(folder / name)
        log = read_times(folder / name)
        known[name] = {
            "sequences": len(sequences),
            "frames": sum(s.motion.num_frames for s in sequences),
            "garments": sum(len(s.offsets) for s in sequences),
            "came_off": sum(not is_trainable(s, t) for s in sequences for t in s.offsets),
            "megabytes": round(size / 1e6, 1),
            "seconds": round(sum(x["seconds"] for x in log)) if log else None,
            "sha256": digest,
        }
    with atomic_write(path) as part:
        part.write_text(json.dumps(known, indent=1) + "\n")


def dataset_table(sets: dict[str, str]) -> str:
    """A line for each of some datasets that was measured."""
    known = json.loads((RESULTS / "datasets.json").read_text())
    lines = [
        "| set | clips | frames | garments simulated | came off | MB | core seconds | sha256 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {sets[name]} | {d['sequences']} | {d['frames']:,} | {d['garments']} |"
        f" {d['came_off']} | {d['megabytes']} | {d['seconds'] or 'not logged'} |"
        f" `{d['sha256'][:12]}` |"
        for name, d in known.items()
        if name in sets
    ]
    return "\n".join(lines)


def note_measured(name: str) -> None:
    """Writes the means of packaged weights into their card."""
    path = WEIGHTS / name / "card.json"
    if not path.is_file():
        return
    card = json.loads(path.read_text())
    rows = read(CLOTHES if card["model"].get("conditions") else FITTED)
    card["measured"] = [
        {
            "method": method,
            "reference": engine,
            "template": t,
            "rmse_vertices_mm": round(found["rmse_vertices_mm"], 2),
            "rmse_vertices_mm_lbs": round(plain["rmse_vertices_mm"], 2),
        }
        for engine in dict.fromkeys(r.engine for r in rows)
        for method in (name, f"{name}+relax+push", f"{name}+guided")
        for t in TEMPLATES
        if (found := means(rows, method, t, engine)) and (plain := means(rows, "lbs", t, engine))
    ]
    with atomic_write(path) as part:
        part.write_text(json.dumps(card, indent=1))


def claims() -> str:
    """The paper's claims beside what came out here."""
    lines = ["| data | network | claim | measured | holds |", "|---|---|---|---|---|"]
    for path, label in ((FITTED, "fitted"), (CLOTHES, "with ease")):
        rows = read(path)
        for engine in dict.fromkeys(r.engine for r in rows):
            here = [r for r in rows if r.engine == engine]
            for network in NETWORKS[path]:
                lines += [
                    f"| {label}, {engine} | {network} | {claim} | {value} |"
                    f" {'yes' if holds else 'no'} |"
                    for claim, value, holds in claims_of(here, network)
                ]
    lines += [
        f"| any | {network} | {claim} | {value} | {'yes' if holds else 'no'} |"
        for network in ("base", "paper")
        for claim, value, holds in claims_of_time(network)
    ]
    return "\n".join(lines)


def claims_of(rows: list[ActionError], network: str) -> list[tuple[str, str, bool]]:
    """Claims on errors, what was measured, and whether they hold."""
    error = {(r.method, r.template, action_name(r)): r.rmse_vertices_mm for r in rows}
    cells = [k for k in error if k[0] == network and ("lbs", *k[1:]) in error]
    if not cells:
        return []

    def mean(name: str, these: tuple[str, ...] = ACTIONS) -> float:
        return statistics.fmean(
            error[network, name, a] for a in these if (network, name, a) in error
        )

    wins = sum(error[k] < error["lbs", *k[1:]] for k in cells)
    top, bottom, dress = (mean(t) for t in TEMPLATES)
    times = 2 * dress / (top + bottom)
    soft, abrupt = (statistics.fmean(mean(t, these) for t in TEMPLATES) for these in (SOFT, ABRUPT))
    return [
        ("better than skinning", f"{wins} of {len(cells)} cells", wins == len(cells)),
        (
            "top and bottom alike (within a quarter)",
            f"{top:.1f} and {bottom:.1f} mm",
            abs(top - bottom) < 0.25 * max(top, bottom),
        ),
        ("dress about twice (1.5 to 2.5 times)", f"{times:.2f} times", 1.5 <= times <= 2.5),
        (
            "soft actions lower than abrupt ones",
            f"{soft:.1f} and {abrupt:.1f} mm",
            soft < abrupt,
        ),
    ]


def claims_of_time(weights: str) -> list[tuple[str, str, bool]]:
    """What the paper says of its time, beside accuracy_cost.json (two CPU cores, a frame live)."""
    one, three = (time_of("network", weights, n) for n in (1, 3))
    return [
        (
            "one pass serves three garments (less than three times one's time)",
            f"{three['ms_network']:.2f} and {one['ms_network']:.2f} ms",
            three["ms_network"] < 3 * one["ms_network"],
        ),
        (
            "31 ms a frame for three garments (GTX 1080, files included)",
            f"{three['ms_per_frame']:.1f} ms (two CPU cores, no files)",
            three["ms_per_frame"] <= 31.0,
        ),
    ]


def time_of(method: str, size: str, garments: int) -> dict:
    """A row of accuracy_cost.json in float32, one frame at a time (skinning: sixteen)."""
    rows = json.loads((RESULTS / "accuracy_cost.json").read_text())["rows"]
    wanted = {"method": method, "size": size, "garments": garments, "precision": "float32"}
    (found,) = (r for r in rows if r["batch"] != 32 and wanted.items() <= r.items())
    return found


def sizes_table() -> str:
    """The paper's table of sizes and times with two columns of ours."""
    skinned, ours = time_of("lbs", "-", 1), time_of("network", "base", 1)
    pushed = time_of("network+push", "base", 1)
    mesh = template("top").mesh
    # As the paper's 3D models: positions and triangles in four bytes a number.
    size = 4e-6 * (mesh.vertices.size + mesh.faces.size)
    weights = f"{ours['weights_mb']:.1f} MB for all three garments"
    here = f"{ours['ms_per_frame']:.1f} ms, {pushed['ms_per_frame']:.1f} with collisions resolved"
    return "\n".join(
        [
            "| | LBS (paper) | TailorNet (paper) | PhysXNet (paper) | `lbs` here | `base` here |",
            "|---|---|---|---|---|---|",
            f"| 3D model, shirt | 1 MB | 13.5 GB | 1 MB | {size:.2f} MB | {size:.2f} MB |",
            f"| weights, shirt | - | 2.5 GB | 1 GB | - | {weights} |",
            "| time a frame, shirt | 3 ms | 1 s | 30 ms (GTX 1080, files included) |"
            f" {skinned['ms_per_frame']:.2f} ms (two CPU cores, no files) | {here} (likewise) |",
        ]
    )


if __name__ == "__main__":
    main()
