"""Writes the pages of docs/reference from the program itself.

Command: python docs/generate.py
Result:  docs/reference/*.md and scene.schema.json; tests/test_docs.py compares them.
"""

import ast
import dataclasses
import inspect
import json
import pathlib
import textwrap
import typing
from typing import Any

import physxnet_jax.errors as errors
from physxnet_jax.cli._main import _COMMANDS
from physxnet_jax.dressing import CHARACTER_FORMATS, attribute_notes, scene_schema
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import FABRICS, KINDS, Fabric
from physxnet_jax.io import EXTENSIONS, GARMENT_FORMATS
from physxnet_jax.models import list_weights, read_card
from physxnet_jax.motion import JOINT_MAPS
from physxnet_jax.simulation import EFFECTS, Status

HERE = pathlib.Path(__file__).parent / "reference"


def field_notes(kind: type) -> dict[str, str]:
    """The strings that follow the fields of a class, its bases included."""
    notes: dict[str, str] = {}
    for one in reversed(kind.__mro__[:-1]):
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(one)))
        except (OSError, TypeError):
            continue
        body = tree.body[0].body  # pyright: ignore[reportAttributeAccessIssue]
        for a, b in zip(body, body[1:]):
            named = isinstance(a, ast.AnnAssign) and isinstance(a.target, ast.Name)
            if named and isinstance(b, ast.Expr) and isinstance(b.value, ast.Constant):
                notes[a.target.id] = " ".join(str(b.value.value).split())
    return notes


def shown(value: Any) -> str:
    """A default value as it is written on the command line."""
    if value is None or value is dataclasses.MISSING:
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):
        return f"`{' '.join(map(str, value))}`" if value else ""
    return f"`{value}`"


def plain(annotation: Any) -> Any:
    """An annotation without `Annotated` and tyro's markers."""
    while typing.get_origin(annotation) is typing.Annotated:
        annotation = typing.get_args(annotation)[0]
    return annotation


def option_rows(kind: type) -> list[tuple[str, str, str]]:
    """Name, default and description of the options of a command, groups included."""
    notes, hints = field_notes(kind), typing.get_type_hints(kind, include_extras=True)
    rows = []
    for field in dataclasses.fields(kind):
        annotation = hints[field.name]
        given = field.default
        if given is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            given = field.default_factory()
        bare = plain(annotation)
        if dataclasses.is_dataclass(given) or dataclasses.is_dataclass(bare):
            group = type(given) if dataclasses.is_dataclass(given) else bare
            own = option_rows(group)
            changed = given if dataclasses.is_dataclass(given) else None
            for name, default, note in own:
                value = getattr(changed, name.strip("-").replace("-", "_"), None)
                rows.append((name, shown(value) or default, note))
            continue
        positional = "Positional" in str(annotation)
        name = field.name.upper() if positional else f"--{field.name.replace('_', '-')}"
        rows.append((name, shown(given), notes.get(field.name, "")))
    return rows


def cli_page() -> str:
    """Every command with its options."""
    lines = ["# Commands", "", "`physxnet COMMAND --help` shows the same.", ""]
    group = ""
    for name, handler in _COMMANDS.items():
        if handler.group != group:
            group = handler.group
            lines += [f"## {group[0].upper()}{group[1:]}", ""]
        text = inspect.cleandoc(handler.options.__doc__ or "")
        about, _, examples = text.partition("Examples:")
        lines += [f"### `physxnet {name}`", "", about.strip(), ""]
        if examples.strip():
            lines += ["```", *(x.strip() for x in examples.strip().splitlines()), "```", ""]
        kinds = _choices(handler.options)
        for title, kind in kinds:
            if title:
                lines += [f"`physxnet {name} {title}`", ""]
            lines += ["| option | default | |", "|---|---|---|"]
            lines += [
                f"| `{o}` | {d} | {n.replace('|', chr(92) + '|')} |"
                for o, d, n in option_rows(kind)
            ]
            lines.append("")
    return "\n".join(lines)


def _choices(kind: type) -> list[tuple[str, type]]:
    """A command's own options, and those of its subcommands."""
    found = []
    for field in dataclasses.fields(kind):
        hint = plain(typing.get_type_hints(kind, include_extras=True)[field.name])
        parts = [plain(a) for a in typing.get_args(hint)]
        if len(parts) > 1 and all(dataclasses.is_dataclass(p) for p in parts):
            names = [_subcommand(a) for a in typing.get_args(hint)]
            found += [(n, p) for n, p in zip(names, parts)]
    return found or [("", kind)]


def _subcommand(annotation: Any) -> str:
    named = [getattr(a, "name", None) for a in typing.get_args(annotation)[1:]]
    return next((n for n in named if n), plain(annotation).__name__.lower())


def scene_page() -> str:
    """Every key of a scene file."""
    schema = scene_schema()
    lines = [
        "# Scene files",
        "",
        "A scene is a TOML file: a motion, garments and the effects that act on them.",
        "`physxnet simulate scene.toml` runs it, `physxnet effects scene.toml` measures what each",
        "effect costs and changes, `physxnet_jax.dressing.load_scene` reads it.",
        "[scene.schema.json](scene.schema.json) is its schema, for editors (`#:schema",
        "scene.schema.json` in the first line) and programs.",
        "",
        "```toml",
        *(SCENE.strip().splitlines()),
        "```",
        "",
        "| key | type | default | |",
        "|---|---|---|---|",
    ]
    for name, entry in schema["properties"].items():
        kind = " or ".join(entry["enum"]) if "enum" in entry else entry["type"]
        default = json.dumps(entry["default"]) if "default" in entry else ""
        lines.append(f"| `{name}` | {kind} | {default} | {entry['description']} |")
    lines += [
        "",
        "A garment is a word as for `--wear` (`shirt:ease=0.12`, `coat.obj:unit=cm`), or a table",
        "of `file`, `fabric` and `pin`. A [fabric](fabrics.md) is a name or a table of numbers,",
        "`pin` a list of vertices that move with the skin, numbered from 0 as in the result.",
        "",
        "## Effects",
        "",
        "Without `standard = false` the standard effects act as well: gravity, damping, stretching",
        "(the membrane for fabrics with stiffnesses of their own), bending, contact with the body,",
        "pins; bands, layers and the floor where they are called for. `air` takes the place of",
        "`damping`, `membrane` of `stretch`, `dihedral` of `bend`.",
        "",
    ]
    for name, entry in schema["properties"]["effects"]["properties"].items():
        lines += [f"### `[effects.{name}]`", "", entry["description"], ""]
        if entry["properties"]:
            lines += ["| setting | type | default | |", "|---|---|---|---|"]
            for key, field in entry["properties"].items():
                default = json.dumps(field["default"]) if "default" in field else ""
                kind = field.get("type", "")
                note = field["description"].replace("|", "\\|")
                lines.append(f"| `{key}` | {kind} | {default} | {note} |")
            lines.append("")
    return "\n".join(lines)


SCENE = """
motion = "walk"
frames = 60
accuracy = "standard"

[[garments]]
file = "trousers"
fabric = "denim"

[[garments]]
file = "shirt"
fabric = {base = "silk", density = 0.1}

[effects.air]
wind = [0.0, 0.0, 4.0]
"""


def fabrics_page() -> str:
    """Parameters of the fabrics."""
    notes = attribute_notes(Fabric)
    names = [f.name for f in dataclasses.fields(Fabric)]
    lines = [
        "# Fabrics",
        "",
        "`--fabric silk` for all garments, `shirt:fabric=silk` for one, numbers in a scene file.",
        "On the command line and in Python a file that ends in `.toml` may stand for the name,",
        "with the numbers that differ from those of its `base` (cotton if it names none):",
        "",
        "```toml",
        'base = "wool"',
        "density = 0.31",
        "bend = 4e-5",
        "```",
        "",
        f"| fabric | {' | '.join(names)} |",
        "|---|" + "---|" * len(names),
    ]
    for name, fabric in FABRICS.items():
        values = (getattr(fabric, n) for n in names)
        cells = ("" if v is None else f"{v:g}" for v in values)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", "| parameter | |", "|---|---|"]
    return "\n".join([*lines, *(f"| {n} | {notes[n]} |" for n in names), ""])


def joints_page() -> str:
    """Joint names of every known family."""
    families = list(JOINT_MAPS)
    lines = [
        "# Joint names",
        "",
        "Families of joint names that are recognised, whatever prefix precedes them; case, spaces",
        "dots, dashes and underscores are ignored. For other names write a joint map: lines with",
        'a name from the column *body* and one of your file\'s, as in `Hips = "belly"`.',
        "",
    ]
    joints = list(dict.fromkeys(j for f in families for j in JOINT_MAPS[f]))
    for at in range(0, len(families), 4):
        part = families[at : at + 4]
        lines += [f"| body | {' | '.join(part)} |", "|---|" + "---|" * len(part)]
        for j in joints:
            cells = (JOINT_MAPS[f].get(j, "") for f in part)
            lines.append(f"| {j} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def weights_page() -> str:
    """The networks that are shipped."""
    lines = [
        "# Weights",
        "",
        "Networks that come with the package: `--weights NAME`, `px.load_predictor(NAME)`.",
        "A folder written by `physxnet train` or `adapt` is given by its path.",
        "",
        "| name | channels | maps | sees the garment | licence | acknowledgement |",
        "|---|---|---|---|---|---|",
    ]
    for name in list_weights():
        card = read_card(name)
        model = card["model"]
        sees = "yes" if model.get("conditions") else "no"
        size = model.get("resolution", "")
        lines.append(
            f"| `{name}` | {model.get('width', '')} | {size} | {sees} | {card['licence']} |"
            f" {card['acknowledgement']} |"
        )
    return "\n".join([*lines, ""])


def status_page() -> str:
    """Status flags of a simulation."""
    notes = field_notes_of_enum(Status)
    lines = [
        "# Status flags",
        "",
        "`Rollout.status` and the reports of `simulate` and `stress` hold a combination of these",
        "for every frame.",
        "",
        "| flag | value | meaning | what to do |",
        "|---|---|---|---|",
    ]
    for flag in Status:
        note = notes[flag.name].replace("`", "")
        lines.append(f"| {flag.name} | {flag.value} | {note} | {flag.advice} |")
    return "\n".join([*lines, ""])


def field_notes_of_enum(kind: type) -> dict[str, str]:
    """The strings that follow the members of an enumeration."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body  # pyright: ignore
    notes = {}
    for a, b in zip(body, body[1:]):
        if isinstance(a, ast.Assign) and isinstance(b, ast.Expr):
            notes[a.targets[0].id] = " ".join(str(b.value.value).split())  # pyright: ignore
    return notes


def errors_page() -> str:
    """Exceptions and exit codes."""
    kinds = [
        (n, k)
        for n, k in vars(errors).items()
        if inspect.isclass(k) and issubclass(k, Exception) and k.__module__ == errors.__name__
    ]
    lines = [
        "# Errors",
        "",
        "What a file or a scene does wrong is a `PhysXNetError`; a message names the file or the",
        "value, what is wrong and how to fix it. Settings of effects, solvers and fabrics that are",
        "out of range raise `ValueError` where they are made. The command prints no traceback",
        "without `--debug`.",
        "",
        "| exception | meaning |",
        "|---|---|",
    ]
    for name, kind in kinds:
        about = (inspect.getdoc(kind) or "").partition("\n")[0]
        lines.append(f"| `{name}` | {about} |")
    lines += [
        "",
        "| exit code | meaning |",
        "|---|---|",
        "| 0 | done |",
        "| 1 | a file has problems (`inspect`, `fit`), a garment came off (`--strict`), or a check"
        " fails |",
        "| 2 | an input or an option is wrong |",
        "| 130 | stopped by Ctrl-C |",
        "",
    ]
    return "\n".join(lines)


def formats_page() -> str:
    """File formats that are read and written."""
    rows = {
        "motions, read": (".bvh", ".amc", ".glb", ".gltf", ".vrma", ".npz", ".pkl"),
        "animated persons, read": CHARACTER_FORMATS,
        "garments, read": GARMENT_FORMATS,
        "results, written": EXTENSIONS,
        "previews, written": (".png", ".gif", ".mp4"),
    }
    lines = ["# Formats", "", "| | extensions |", "|---|---|"]
    lines += [f"| {k} | {', '.join(f'`{e}`' for e in v)} |" for k, v in rows.items()]
    lines += [
        "",
        "Lengths are metres, Y is up, the person faces along Z. A garment file's declared unit and",
        "axis count first (glTF, USD); [garments](../garments.md) says how others are found.",
        "",
        "## Arrays of `.npz` results",
        "",
        "| key | shape | |",
        "|---|---|---|",
        "| `NAME_positions` | [frames, vertices, 3] | positions of a mesh [m]; NAME may be body |",
        "| `NAME_faces` | [faces, 3] | its triangles, int32 |",
        "| `fps` | [] | frames per second |",
        "",
        "## Arrays of `.npz` motions",
        "",
        "| key | shape | |",
        "|---|---|---|",
        "| `rotations` | [frames, joints, 4] | local rotations of joints, quaternions wxyz |",
        "| `root` | [frames, 3] | position of the hips [m] |",
        "| `fps` | [] | frames per second |",
        "",
        "Arrays of AMASS, AIST++ and 4D-Humans: [motion](../motion.md).",
        "",
        "## Garments and effects by name",
        "",
        f"Tailored: {', '.join(f'`{k}`' for k in KINDS)}. Effects: "
        f"{', '.join(f'`{e}`' for e in EFFECTS)}.",
        "",
    ]
    return "\n".join(lines)


PAGES = {
    "cli": cli_page,
    "scene-files": scene_page,
    "fabrics": fabrics_page,
    "formats": formats_page,
    "joint-names": joints_page,
    "weights": weights_page,
    "status-flags": status_page,
    "errors": errors_page,
}


def pages() -> dict[str, str]:
    """Content by file name."""
    made = {f"{name}.md": page().rstrip() + "\n" for name, page in PAGES.items()}
    return made | {"scene.schema.json": json.dumps(scene_schema(), indent=1) + "\n"}


if __name__ == "__main__":
    for name, text in pages().items():
        with atomic_write(HERE / name) as part:
            part.write_text(text, encoding="utf-8")
