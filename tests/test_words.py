"""The check of words finds what it is for."""

import runpy
from pathlib import Path

import pytest

CHECK = runpy.run_path(str(Path(__file__).with_name("check_words.py")))


def test_no_private_word_is_left():
    assert CHECK["main"]() == 0


@pytest.mark.parametrize(
    "text",
    [
        "the program tells",
        "Somebody",
        "is asked",
        "mended",
        "a Wearable",
        "push_out",
        "the file says",
    ],
)
def test_private_words_are_found(text):
    assert CHECK["found"](text)


@pytest.mark.parametrize(
    "text", ["the file states", "recommended", "log.tell()", "basket of hands"]
)
def test_other_words_are_not(text):
    assert not CHECK["found"](text)
