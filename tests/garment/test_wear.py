"""``NAME[:key=value,...]``: what is worn, as people write it."""

import dataclasses

import pytest

from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.garment import (
    FABRICS,
    find_fabric,
    load_garment,
    parse_wear,
    tailor,
    template,
    with_default_fabric,
)


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("top", ("top", None, None)),
        ("coat.obj", ("coat.obj", None, None)),
        ("coat.obj:as=top,fabric=wool", ("coat.obj", "top", "wool")),
        ("coat.glb#sleeves:fabric=silk", ("coat.glb#sleeves", None, "silk")),
        ("C:/coats/coat.obj:as=dress", ("C:/coats/coat.obj", "dress", None)),
        ("C:/coats/coat.obj", ("C:/coats/coat.obj", None, None)),
    ],
)
def test_words_are_parsed(word, expected):
    item = parse_wear(word)
    assert (item.name, item.template, item.fabric) == expected


@pytest.mark.parametrize(
    ("word", "fix"),
    [
        ("top:colour=red", "there are as, fabric"),
        ("a.obj:as=hat", "one of top, bottom, dress"),
        ("top:fabric=tin", "there are cotton"),
        ("top:ease=0.1", "there are as, fabric"),
        ("bottom:unit=cm", "there are as, fabric"),
        ("dress:made_on=avatar.obj", "there are as, fabric"),
        ("tee:as=top", "there are fabric, hold, ease"),
        ("tee:ease=wide", "expected metres, as in ease=0.1"),
    ],
)
def test_unknown_options_are_refused(word, fix):
    with pytest.raises(PhysXNetError, match=fix):
        parse_wear(word)


def test_measures_of_tailored_garments_are_parsed_and_written():
    item = parse_wear("skirt:length=0.5,hold=waist+hem,fabric=denim")
    assert item.measures == {"length": 0.5} and item.hold == ("waist", "hem")
    assert item.word("skirt") == "skirt:length=0.5,hold=waist+hem"
    again = parse_wear(item.word(item.name))
    assert (again.measures, again.hold, again.fabric) == (item.measures, item.hold, None)
    assert parse_wear("skirt").hold == () and parse_wear("skirt").measures == {}
    assert parse_wear("coat.obj:as=top").word("/a/coat.obj") == "/a/coat.obj:as=top"


def test_tailored_garments_are_loaded_by_name(body):
    garment, report = load_garment("shorts:ease=0.12,fabric=denim")
    assert (garment.name, garment.template, report.warning) == ("shorts", "bottom", None)
    assert garment.fabric.density == FABRICS["denim"].density
    broad = body.shape(weight_up=1.0)
    wide, _ = load_garment("shorts", shape=broad)
    usual, _ = load_garment("shorts")
    rest = body.rest_vertices(broad)
    assert abs(wide.rest_vertices(rest) - usual.rest_vertices(rest)).max() > 0.005


def test_the_default_fabric_applies_where_none_is_named():
    words = ("top", "a.obj:as=top", "bottom:fabric=wool")
    assert with_default_fabric(words, None) == words
    made = with_default_fabric(words, "silk")
    assert [parse_wear(w).fabric for w in made] == ["silk", "silk", "wool"]
    assert parse_wear(made[1]).template == "top"
    with pytest.raises(PhysXNetError, match="there are cotton"):
        with_default_fabric(words, "tin")


def test_a_garment_is_made_of_the_fabric():
    garment, _ = load_garment("bottom:fabric=silk")
    assert garment.fabric.density == FABRICS["silk"].density
    assert garment.fabric.thickness >= template("bottom").fabric.thickness
    with pytest.raises(PhysXNetError, match="is a template"):
        load_garment("bottom:as=top")


def test_fabric_files_are_taken_where_names_are(tmp_path):
    linen = tmp_path / "linen.toml"
    linen.write_text('base = "wool"\ndensity = 0.19\nbend = 3e-5\n')
    found = find_fabric(linen)
    assert found == dataclasses.replace(FABRICS["wool"], density=0.19, bend=3e-5)
    assert load_garment(f"top:fabric={linen}")[0].fabric.density == 0.19
    assert tailor("tee", fabric=str(linen)).fabric.bend == 3e-5
    assert with_default_fabric(["top"], str(linen)) == (f"top:fabric={linen}",)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("weight = 1.0", "a fabric has no 'weight'"),
        ("density = nan", "density"),
        ('density = "thick"', "expected a number"),
        ('base = "tin"', "no fabric 'tin'"),
        ("density = ", "tin.toml"),
        ("#" * 200_000, "too large"),
        ('base = ["wool"]', "no fabric"),
        ("density = 1" + 400 * "0", "float"),
        ("a = " + 20_000 * "[", "tin.toml"),
    ],
)
def test_fabric_files_with_faults_are_refused_by_name(text, match, tmp_path):
    path = tmp_path / "tin.toml"
    path.write_text(text)
    with pytest.raises(FormatError, match=match) as error:
        parse_wear(f"top:fabric={path}")
    assert str(error.value).count(str(path)) == 1


def test_fabric_files_that_are_not_there_are_named(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        find_fabric(tmp_path / "none.toml")
    with pytest.raises(PhysXNetError, match="No fabric 'tin'; there are cotton"):
        find_fabric("tin")
