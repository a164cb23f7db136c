"""Readers under a fuzzer that sees which lines its inputs reach.

Command: pip install atheris; python tests/fuzz/search.py bvh
         --seconds 600, --corpus runs/fuzz: what was found is kept and gone on from.
         `all` takes the readers in turn, each in a process of its own.
Cost:    what --seconds says, for each reader.
Result:  nothing; an input that breaks a reader in any other way than by one of the package's
         own errors is written to the corpus as crash-..., and the exit status isn't 0.

Readers and their good files are those of readers.py.
"""

import argparse
import pathlib
import runpy
import subprocess
import sys
import tempfile

TESTS = pathlib.Path(__file__).with_name("readers.py")
INSTRUMENTED = ["physxnet_jax.motion", "physxnet_jax.io", "physxnet_jax.files"]


def fuzz(name: str, seconds: int, corpus: pathlib.Path) -> None:
    """Doesn't return: the fuzzer ends the process."""
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED):
        made = runpy.run_path(str(TESTS))
    corpus.mkdir(parents=True, exist_ok=True)
    folder = pathlib.Path(tempfile.mkdtemp(prefix="physxnet-fuzz-"))
    (corpus / "good").write_bytes(made["READERS"][name][0](folder))
    tried = made["tried"]

    def one(data: bytes) -> None:
        tried(name, folder, data)

    words = [str(corpus), f"-max_total_time={seconds}", f"-artifact_prefix={corpus}/"]
    atheris.Setup([sys.argv[0], *words, "-timeout=60", "-rss_limit_mb=4096"], one)
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reader")
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--corpus", type=pathlib.Path, default=pathlib.Path("runs/fuzz"))
    words = parser.parse_args()
    names = list(runpy.run_path(str(TESTS))["READERS"]) if words.reader == "all" else []
    if not names:
        fuzz(words.reader, words.seconds, words.corpus / words.reader.replace(" ", "_"))
    worst = 0
    for name in names:
        again = [sys.executable, __file__, name, "--seconds", str(words.seconds)]
        worst |= subprocess.run([*again, "--corpus", str(words.corpus)]).returncode
    return int(worst != 0)


if __name__ == "__main__":
    sys.exit(main())
