"""Every prototype: believable measures, box, labels, and the same one each time."""

import numpy as np
import pytest

from warploom.models.classes import BARRIER, CONE, CYCLIST, PEDESTRIAN, VEHICLE
from warploom.models.simulator.labels import Material, PointClass, material_table
from warploom.models.simulator.library import KINDS, Library, object_class, prototype

# Length, width, height [m]: least and most.
SIZES = {
    "hatch": ((3.6, 4.4), (1.6, 1.85), (1.35, 1.6)),
    "micro": ((2.4, 3.3), (1.45, 1.7), (1.4, 1.65)),
    "sedan": ((4.2, 5.1), (1.65, 1.9), (1.3, 1.55)),
    "suv": ((4.1, 5.0), (1.7, 2.0), (1.5, 1.9)),
    "van": ((4.6, 5.8), (1.8, 2.1), (1.85, 2.6)),
    "truck": ((5.8, 10.3), (2.1, 2.6), (2.6, 3.8)),
    "bus": ((8.8, 12.5), (2.4, 2.6), (2.7, 3.3)),
    "pedestrian": ((0.2, 1.3), (0.3, 0.9), (1.0, 2.0)),
    "cyclist": ((1.6, 2.0), (0.4, 0.9), (1.5, 2.1)),
    "cone": ((0.2, 0.6), (0.2, 0.6), (0.45, 1.0)),
    "column": ((0.5, 2.2), (0.5, 2.2), (1.5, 4.5)),
    "gate": ((1.5, 5.7), (0.1, 0.7), (0.9, 2.7)),
    "topiary": ((0.9, 4.9), (0.7, 2.4), (0.7, 2.3)),
}


@pytest.mark.parametrize("kind", list(KINDS))
def test_prototypes_are_sound(kind):
    thing = prototype(kind, 0)
    shape = thing.shape
    assert np.isfinite(shape.vertices).all()
    assert shape.faces.min() >= 0
    assert shape.faces.max() < len(shape.vertices)
    assert np.all(shape.labels % 256 <= max(Material))
    assert np.all(shape.labels // 256 <= max(PointClass))
    if object_class(kind) >= 0:
        low, high = shape.bounds()
        assert np.allclose(low[:2] + high[:2], 0, atol=1e-9)
        assert low[2] == pytest.approx(0)
        assert np.allclose(thing.hull.min(0), low)
        assert np.allclose(thing.hull.max(0), high)
        assert len(set((shape.labels // 256).tolist())) == 1


@pytest.mark.parametrize("kind", list(SIZES))
def test_things_have_the_size_of_real_ones(kind):
    for variant in range(min(KINDS[kind], 5)):
        for size, (least, most) in zip(prototype(kind, variant).size, SIZES[kind], strict=True):
            assert least <= size <= most


@pytest.mark.parametrize("kind", ["sedan", "pedestrian", "facade"])
def test_the_same_prototype_again(kind):
    again = prototype.__wrapped__(kind, 1)
    assert again.shape.vertices.tobytes() == prototype(kind, 1).shape.vertices.tobytes()


def test_a_car_is_no_box():
    # The cabin is narrower than the body, the bonnet lower than the roof, the mirrors stand outside the box.
    shape = prototype("sedan", 0).shape
    length, width, height = prototype("sedan", 0).size
    x, y, z = shape.vertices[shape.boxed].T
    assert np.abs(y[z > 0.9 * height]).max() < 0.45 * width
    assert z[x > 0.4 * length].max() < 0.75 * height
    assert np.abs(shape.vertices[~shape.boxed][:, 1]).max() > width / 2
    assert (shape.labels % 256 == Material.GLASS).any()


def test_flanks_of_cars_are_bowed_and_boxes_as_wide_as_their_middle():
    for kind in ("hatch", "sedan", "wagon", "suv"):
        for variant in range(4):
            made = prototype(kind, variant)
            length, width, height = made.size
            x, y, z = made.shape.vertices[made.shape.boxed].T
            body = (z > 0.3 * height) & (z < 0.6 * height)
            half = [np.abs(y[body & (np.abs(x / length - at) < 0.03)]).max() for at in (-0.45, -0.25, 0.0, 0.25, 0.45)]
            assert half[2] == pytest.approx(width / 2, abs=0.03)  # the middle of the lofted side is a little inside
            # Each bumper is 2 % to 22 % narrower at nine tenths of the way, and the flank goes there step by step.
            for end, between in ((half[0], half[1]), (half[4], half[3])):
                assert 0.7 * half[2] < end < 0.98 * half[2]
                assert end < between <= half[2]


def test_walkers_swing_their_legs():
    lengths = [prototype("pedestrian", 3, phase).size[0] for phase in range(8)]
    assert max(lengths) - min(lengths) > 0.15
    heights = [prototype("pedestrian", 3, phase).size[2] for phase in range(8)]
    assert max(heights) - min(heights) < 0.15


def test_kinds_have_their_classes():
    assert [object_class(k) for k in ("bus", "stander", "cyclist", "cone", "barrier", "tree", "bike_rack")] == [
        VEHICLE, PEDESTRIAN, CYCLIST, CONE, BARRIER, -1, -1,
    ]  # fmt: skip


def test_materials_are_shares():
    table = material_table()
    assert table.shape == (256, 6)
    assert table.min() >= 0
    assert table.max() <= 1
    assert (table[: len(Material), 0] > 0).all()


def test_a_library_builds_each_mesh_once():
    library = Library()
    first = library.number("cone", 0)
    assert library.number("cone", 1) != first
    assert library.number("cone", 0) == first


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="kind must be one of"):
        prototype("dragon", 0)
