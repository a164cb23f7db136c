import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.errors import MeshError
from physxnet_jax.geometry import Material, Polygons, joined_polygons, make_material


def house(**changes):
    """A square, a triangle on it, and a pentagon."""
    parts = {
        "counts": np.array([4, 3, 5], np.int32),
        "corners": np.array([0, 1, 2, 3, 3, 2, 4, 0, 3, 4, 5, 6], np.int32),
        "uv_corners": None,
        "material": np.array([0, 1, -1], np.int32),
        "materials": (Material("wall"), Material("roof", (1.0, 0.0, 0.0))),
    }
    return Polygons(**(parts | changes))


def rings(p):
    return [p.corners[a : a + n].tolist() for a, n in zip(p.starts, p.counts)]


def test_triangles_map_to_their_polygon():
    assert house().of_triangle.tolist() == [0, 0, 1, 2, 2, 2]


def test_equal_polygons_compare_equal_and_share_one_trace():
    traced = []

    @jax.jit(static_argnums=1)
    def f(x, polygons):
        traced.append(polygons)
        return x * len(polygons.counts)

    x = jnp.ones(2)
    f(x, house()), f(x, house())
    assert len(traced) == 1 and hash(house()) == hash(house()) and house() == house()
    # What differs in anything that is written is another one.
    others = [
        house(material=np.array([0, 1, 1], np.int32)),
        house(materials=(Material("wall"), Material("roof", (1.0, 0.0, 0.1)))),
        house(uv_corners=np.zeros(12, np.int32)),
        house(corners=house().corners[::-1].copy()),
    ]
    assert all(house() != other for other in others) and house() != "house"
    f(x, others[0])
    assert len(traced) == 2


def test_polygons_can_be_selected_reversed_and_renumbered():
    p = house(uv_corners=np.arange(12, dtype=np.int32))
    some = p.chosen([2, 0])
    assert rings(some) == [[0, 3, 4, 5, 6], [0, 1, 2, 3]] and some.material.tolist() == [-1, 0]
    assert some.uv_corners.tolist() == [7, 8, 9, 10, 11, 0, 1, 2, 3]
    turned = p.reversed([0])
    assert rings(turned)[:2] == [[0, 3, 2, 1], [3, 2, 4]]
    assert turned.uv_corners[:5].tolist() == [0, 3, 2, 1, 4]
    assert turned.reversed([0]) == p
    moved = p.at(np.arange(7) + 10)
    assert moved is not None and rings(moved)[1] == [13, 12, 14]
    # A corner that falls onto its neighbour leaves no polygon.
    assert p.at(np.array([0, 0, 2, 3, 4, 5, 6])) is None
    assert len(p.chosen([]).counts) == 0


def test_joined_meshes_share_materials_of_equal_name_and_colour():
    both = joined_polygons(
        [(house(), 7, 0), (house(materials=(Material("roof"), *house().materials[1:])), 7, 0)]
    )
    assert [m.name for m in both.materials] == ["wall", "roof", "roof"]
    assert both.material.tolist() == [0, 1, -1, 2, 1, -1]
    assert rings(both)[3] == [7, 8, 9, 10] and both.uv_corners is None
    textured = house(uv_corners=np.arange(12, dtype=np.int32))
    rows = joined_polygons([(textured, 7, 12), (textured, 7, 12)]).uv_corners
    assert rows is not None and rows.tolist() == list(range(24))
    assert joined_polygons([(textured, 7, 12), (house(), 7, 0)]).uv_corners is None
    with pytest.raises(MeshError, match="at least one"):
        joined_polygons([])


@pytest.mark.parametrize(
    ("told", "colour"),
    [
        ([0.1, 0.2, 0.3], (0.1, 0.2, 0.3)),
        ([-1, 0, 7], (0.0, 0.0, 1.0)),
        (None, None),
        ([0.1, 0.2], None),
        ([0.1, 0.2, np.nan], None),
        (["a", "b", "c"], None),
    ],
)
def test_material_colours_are_three_numbers_or_none(told, colour):
    assert make_material("m", told).colour == colour
