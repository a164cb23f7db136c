"""Refuses private language in src/, README.md and docs/: `python tests/check_words.py`."""

import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).parents[1]
# Where a word is allowed although it is on the list: none at present.
WORDS = {
    r"told|tells|tell of|(?<!\.)tell\b(?!\()": "report, print, warn, state",
    r"somebody|somebody else": "name who: the user, a character, a file",
    r"of one's own|of somebody else": "custom",
    r"foretell\w*|foretold": "predict",
    r"mends?|mended|mending": "repair, fix",
    r"(is|are) asked\b": "request, call, compute",
    r"by hand": "manually, explicitly",
    r"wearables?": "bound garment",
    r"pushed out|push-out": "collision resolution",
    r"rooms?\b(?= import| and| of `| above|s\b)": "packages, modules",
    r"(program|command|file|header|package|network|simulator|table|page|card) says": "states",
}
# Names of earlier versions.
OLD = (
    "ask_mirrored relax_cloth push_out SkinPatch make_patch tuck_in keep_apart"
    " keep_layers_apart inside_out skin_height skin_foot skirt_meeting skirt_lift poses_before"
    " before_transforms lead_frames wanted_clip cut_clip as_on fit_surface Wearable make_wearable"
    " worn_garments start_clothing clothe_frame start_stream stream_frame Rung Ladder pick_rung"
    " ACCURACY lead_in simulate_still Sheaf sheaves Attached Placed _teach_judge Players"
    " kernel_rate scale_by_orthogonal_momentum _foretell QUANTUM free_programs"
    " keep_programs whole_file each_frame least_index own_body learn_from --own-body --learn-from"
).split()
OLD_NAMES = dict.fromkeys(
    (re.escape(name) + r"(?![\w.]*\.(md|png|json))" for name in OLD), "the field's name"
)


def found(text: str) -> list[tuple[int, str, str]]:
    """Line, word and what to write instead."""
    out = []
    for number, line in enumerate(text.splitlines(), 1):
        for words, flags in ((WORDS, re.IGNORECASE), (OLD_NAMES, 0)):
            for pattern, better in words.items():
                for match in re.finditer(rf"\b(?:{pattern})\b", line, flags):
                    out.append((number, match.group(0), better))
    return out


def main() -> int:
    """Prints every place; 1 if there is one."""
    files = [*(ROOT / "src").rglob("*.py"), ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    places = [(f.relative_to(ROOT), *x) for f in sorted(files) for x in found(f.read_text())]
    for file, line, word, better in places:
        print(f"{file}:{line}: '{word}': {better}")  # noqa: T201
    return 1 if places else 0


if __name__ == "__main__":
    sys.exit(main())
