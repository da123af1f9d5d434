"""What stands still along a street: facades with relief, walls, fences, poles, signs, bins, cones and barriers."""

from __future__ import annotations

import numpy as np

from .labels import Material, PointClass, face_label
from .mesh import Shape, box, ellipsoid, join, loft, quad, relief, tube
from .people import bicycle

__all__ = ["barrier", "bike_rack", "bin_", "bollard", "bus_stop", "cabinet", "cone", "facade", "fence", "hydrant",
           "lamp_post", "motorbike", "sign", "stairs", "table", "wall"]  # fmt: skip

_BUILDING, _POLE, _FENCE, _OTHER = PointClass.BUILDING, PointClass.POLE, PointClass.FENCE, PointClass.OTHER


def _cells(lines: np.ndarray, start: float, stop: float) -> np.ndarray:
    middle = 0.5 * (lines[1:] + lines[:-1])
    return (middle > start) & (middle < stop)


def facade(random: np.random.Generator) -> Shape:
    """The house front in the plane y = 0 facing −y, 6 to 16 m wide along x, with sides, a roof and a room behind.

    Windows lie in niches behind sills, shop fronts in frames under an awning; cornices, pilasters, a door with steps,
    drain pipes, bays and balconies stand out.
    """
    width = random.uniform(6, 16)
    storeys, storey = random.integers(1, 5), random.uniform(2.6, 3.4)
    ground_floor = storey + random.uniform(0, 0.7)
    height = ground_floor + (storeys - 1) * storey + random.uniform(0.2, 1.2)
    stone = (Material.BRICK, Material.PLASTER, Material.PLASTER, Material.CONCRETE)[random.integers(4)]
    masonry, frame = face_label(stone, _BUILDING), face_label(Material.WOOD, _BUILDING)
    pane = face_label(Material.WINDOW, _BUILDING)
    shop = random.random() < 0.35
    bays = max(2, int(width / random.uniform(1.9, 3.2)))
    pitch = width / bays
    opening = pitch * random.uniform(0.38, 0.6)
    niche, sill = random.uniform(0.08, 0.3), random.uniform(0.7, 1.0)
    door = random.integers(bays)
    rects = []  # x from, x to, z from, z to, depth, label
    plinth = random.uniform(0.3, 0.8)
    if random.random() < 0.6:
        rects.append((-width / 2, width / 2, 0.0, plinth, -random.uniform(0.03, 0.1), masonry))
    if random.random() < 0.35:
        for k in range(bays + 1):
            x = -width / 2 + k * pitch
            rects.append((x - 0.18, x + 0.18, 0.0, height, -random.uniform(0.05, 0.14), masonry))
    for k in range(bays):
        middle = -width / 2 + (k + 0.5) * pitch
        for level in range(storeys):
            floor = 0.0 if level == 0 else ground_floor + (level - 1) * storey
            if level == 0 and k == door:
                rects.append((middle - 0.55, middle + 0.55, 0.0, 2.15, niche + 0.15, frame))
                continue
            if level == 0 and shop:
                low, wide = 0.45, 0.42 * pitch
                rects.append((middle - wide, middle + wide, low, ground_floor - 0.6, 0.12, pane))
                continue
            if random.random() < 0.06:
                continue
            low, high = floor + sill, floor + min(sill + random.uniform(1.2, 1.6), storey - 0.25)
            a, b = middle - opening / 2, middle + opening / 2
            rects.append((a - 0.08, b + 0.08, low - 0.1, low, -0.06, masonry))
            rects.append((a, b, low, high, niche - 0.04, frame))
            for left, right in ((a + 0.06, middle - 0.03), (middle + 0.03, b - 0.06)):
                rects.append((left, right, low + 0.06, high - 0.06, niche, pane))
    rects.append((-width / 2, width / 2, height - 0.25, height, -random.uniform(0.05, 0.35), masonry))
    if storeys > 1 and random.random() < 0.5:
        rects.append(
            (-width / 2, width / 2, ground_floor - 0.1, ground_floor + 0.1, -random.uniform(0.04, 0.15), masonry)
        )
    u = np.unique(np.round([-width / 2, width / 2, *(x for r in rects for x in r[:2])], 3))
    u = u[(u >= -width / 2 - 1e-6) & (u <= width / 2 + 1e-6)]
    v = np.unique(np.round([-0.6, 0.0, height, *(z for r in rects for z in r[2:4])], 3))
    depth = np.zeros((len(u) - 1, len(v) - 1))
    labels = np.full(depth.shape, masonry)
    for x0, x1, z0, z1, d, label in rects:
        where = np.ix_(_cells(u, x0, x1), _cells(v, z0, z1))
        depth[where], labels[where] = d, label
    parts = [relief(u, v, depth, labels, masonry)]
    back = random.uniform(7, 11)
    half = width / 2
    for x in (-half, half):
        parts.append(quad(np.array([[x, 0, -0.6], [x, back, -0.6], [x, back, height], [x, 0, height]]), masonry))
    parts.append(
        quad(np.array([[-half, back, -0.6], [half, back, -0.6], [half, back, height], [-half, back, height]]), masonry)
    )
    if random.random() < 0.6:
        ridge = height + random.uniform(1.5, 3.5)
        for x in (-half, half):
            gable = np.array([[x, 0, height], [x, back, height], [x, back / 2, ridge], [x, back / 2, ridge]])
            parts.append(quad(gable, masonry))
        for y in (-0.3, back + 0.3):
            parts.append(
                quad(
                    np.array(
                        [[-half, y, height], [half, y, height], [half, back / 2, ridge], [-half, back / 2, ridge]]
                    ),
                    masonry,
                )
            )
    else:
        parts.append(
            quad(
                np.array([[-half, 0, height], [half, 0, height], [half, back, height], [-half, back, height]]), masonry
            )
        )
    # The rooms: floors and an inner wall, which beams through the panes may find.
    inner = random.uniform(1.5, 4.0)
    room = face_label(Material.PLASTER, _BUILDING)
    parts.append(
        quad(np.array([[-half, inner, 0], [half, inner, 0], [half, inner, height], [-half, inner, height]]), room)
    )
    for level in range(storeys):
        z = 0.05 if level == 0 else ground_floor + (level - 1) * storey
        parts.append(quad(np.array([[-half, 0.3, z], [half, 0.3, z], [half, inner, z], [-half, inner, z]]), room))
    for _ in range(3):
        x = random.uniform(-half + 0.6, half - 0.6)
        parts.append(box((x - 0.4, 0.5, 0.05), (x + 0.4, 0.9, random.uniform(0.8, 1.6)), room))
    metal = face_label(Material.METAL, _BUILDING)
    for x in (-half + 0.15, half - 0.15):
        if random.random() < 0.6:
            parts.append(tube(np.array([[x, -0.09, 0.0], [x, -0.09, height - 0.3]]), 0.05, metal, 6))
    at = -half + (door + 0.5) * pitch
    for step in range(random.integers(0, 4)):
        parts.append(box((at - 0.7, -0.9 + 0.28 * step, -0.3), (at + 0.7, 0.1, 0.15 * (step + 1)), masonry))
    if shop and random.random() < 0.7:
        z = ground_floor - 0.5
        cloth = face_label(Material.CLOTH, _BUILDING)
        parts.append(
            quad(
                np.array(
                    [
                        [-half + 0.3, 0, z + 0.4],
                        [half - 0.3, 0, z + 0.4],
                        [half - 0.3, -1.2, z - 0.05],
                        [-half + 0.3, -1.2, z - 0.05],
                    ]
                ),
                cloth,
            )
        )
        parts.append(
            quad(
                np.array(
                    [
                        [-half + 0.3, -1.2, z - 0.05],
                        [half - 0.3, -1.2, z - 0.05],
                        [half - 0.3, -1.2, z - 0.3],
                        [-half + 0.3, -1.2, z - 0.3],
                    ]
                ),
                cloth,
            )
        )
    for _ in range(random.integers(0, 3)):
        x = -half + (random.integers(bays) + 0.5) * pitch
        if storeys > 1:
            z = ground_floor + random.integers(storeys - 1) * storey
            out = random.uniform(0.7, 1.3)
            parts.append(box((x - 0.9, -out, z), (x + 0.9, 0, z + 0.15), masonry))
            parts.append(
                quad(
                    np.array(
                        [[x - 0.9, -out, z], [x + 0.9, -out, z], [x + 0.9, -out, z + 1.0], [x - 0.9, -out, z + 1.0]]
                    ),
                    face_label(Material.MESH, _BUILDING),
                )
            )
    if random.random() < 0.3:
        x, out = random.uniform(-half + 1.5, half - 1.5), random.uniform(0.4, 0.9)
        parts.append(box((x - 1.1, -out, 0.0), (x + 1.1, 0, ground_floor * random.uniform(0.8, 1.0)), masonry))
    return join(*parts)


def wall(random: np.random.Generator) -> Shape:
    """A garden wall along x with piers and a coping; some carry railings, some are of rough stone."""
    length, height, thick = random.uniform(4, 9), random.uniform(0.5, 2.4), random.uniform(0.15, 0.35)
    label = face_label((Material.BRICK, Material.CONCRETE, Material.PLASTER)[random.integers(3)], _FENCE)
    u = np.linspace(-length / 2, length / 2, int(length / 0.4) + 1)
    v = np.linspace(-0.3, height, max(3, int(height / 0.35)))
    rough = random.choice([0.0, 0.015, 0.05])
    depth = (
        np.round(random.normal(0, rough, (len(u) - 1, len(v) - 1)), 3) if rough else np.zeros((len(u) - 1, len(v) - 1))
    )
    front = relief(u, v, depth, np.full(depth.shape, label), label)
    parts = [front, box((-length / 2, thick / 2, -0.3), (length / 2, thick, height), label)]
    parts.append(box((-length / 2, -0.06, height), (length / 2, thick + 0.06, height + 0.08), label))
    step = random.uniform(2, 4)
    if random.random() < 0.6:
        for x in np.arange(-length / 2, length / 2 + 0.1, step):
            parts.append(box((x - 0.2, -0.1, -0.3), (x + 0.2, thick + 0.1, height + 0.25), label))
    if height < 1.1 and random.random() < 0.5:
        metal = face_label(Material.METAL, _FENCE)
        for x in np.arange(-length / 2, length / 2, 0.14):
            parts.append(box((x, 0.1, height), (x + 0.025, 0.125, height + 0.8), metal))
    return join(*parts)


def fence(random: np.random.Generator) -> Shape:
    """A fence along x: pickets, boards, rails, or wire mesh that most beams pass."""
    length, height = random.uniform(4, 8), random.uniform(0.8, 1.9)
    kind = random.integers(4)
    label = face_label(Material.WOOD if kind < 2 else Material.METAL, _FENCE)
    parts = [
        box((x - 0.05, -0.05, -0.3), (x + 0.05, 0.05, height + 0.05), label)
        for x in np.arange(-length / 2, length / 2 + 0.01, 2.0)
    ]
    if kind == 3:
        mesh = face_label(Material.MESH, _FENCE)
        parts.append(
            quad(
                np.array(
                    [[-length / 2, 0, 0.05], [length / 2, 0, 0.05], [length / 2, 0, height], [-length / 2, 0, height]]
                ),
                mesh,
            )
        )
        return join(*parts)
    for z in (0.25 * height, 0.85 * height):
        parts.append(box((-length / 2, -0.03, z), (length / 2, 0.03, z + 0.07), label))
    step, board = ((0.16, 0.09), (0.2, 0.19), (0.12, 0.02))[kind]
    for x in np.arange(-length / 2, length / 2, step):
        parts.append(
            quad(
                np.array([[x, 0.035, 0.05], [x + board, 0.035, 0.05], [x + board, 0.035, height], [x, 0.035, height]]),
                label,
            )
        )
    return join(*parts)


def lamp_post(random: np.random.Generator) -> Shape:
    """A street lamp, or a traffic light on a mast."""
    metal = face_label(Material.METAL, _POLE)
    height, radius = random.uniform(4.5, 9.0), random.uniform(0.06, 0.12)
    path = np.array([[0, 0, -0.3], [0, 0, 0.9], [0, 0, 0.91], [0, 0, height]])
    parts = [tube(path, radius * np.array([1.5, 1.5, 1.0, 0.6]), metal, 8)]
    if random.random() < 0.6:
        out = random.uniform(0.8, 2.2)
        parts.append(
            tube(
                np.array([[0, 0, height - 0.1], [0, -out / 2, height + 0.2], [0, -out, height + 0.25]]), 0.04, metal, 5
            )
        )
        parts.append(box((-0.14, -out - 0.5, height + 0.17), (0.14, -out, height + 0.3), metal))
    else:
        parts.append(ellipsoid((0, 0, height + 0.2), (0.22, 0.22, 0.28), metal, 4))
    if random.random() < 0.3:
        parts.append(box((-0.17, -0.35, 2.3), (0.17, -0.12, 3.2), metal))
    if random.random() < 0.3:
        parts.append(tube(np.array([[0, 0, 2.6], [0.02, 0, 2.62]]), 0.33, face_label(Material.SIGN, _POLE), 10))
    return join(*parts)


def sign(random: np.random.Generator) -> Shape:
    """A road sign on a thin pole, facing ± x."""
    height = random.uniform(2.0, 2.9)
    parts = [
        tube(np.array([[0, 0, -0.3], [0, 0, height]]), random.uniform(0.03, 0.05), face_label(Material.METAL, _POLE), 6)
    ]
    plate = face_label(Material.SIGN, _POLE)
    if random.random() < 0.6:
        parts.append(
            tube(
                np.array([[-0.05, 0, height - 0.3], [-0.035, 0, height - 0.3]]),
                0.32,
                plate,
                int(random.choice([3, 8, 12])),
            )
        )
    else:
        w, h = random.uniform(0.2, 0.5), random.uniform(0.2, 0.45)
        parts.append(box((-0.06, -w, height - 2 * h), (-0.04, w, height), plate))
    return join(*parts)


def bollard(random: np.random.Generator) -> Shape:
    """A post of 0.6 to 1.1 m."""
    height, radius = random.uniform(0.6, 1.1), random.uniform(0.05, 0.13)
    return tube(
        np.array([[0, 0, -0.1], [0, 0, height - 0.05], [0, 0, height]]),
        radius * np.array([1, 1, 0.6]),
        face_label(Material.METAL, _POLE),
        8,
    )


def bin_(random: np.random.Generator) -> Shape:
    """A wheeled bin, a skip or a litter bin."""
    label = face_label(Material.PLASTIC, _OTHER)
    kind = random.integers(3)
    if kind == 0:
        return join(
            box((-0.28, -0.24, 0.08), (0.26, 0.24, 0.95), label), box((-0.32, -0.28, 0.95), (0.34, 0.28, 1.06), label)
        )
    if kind == 1:
        return join(
            box((-0.5, -0.65, 0.15), (0.45, 0.65, 1.1), label), box((-0.55, -0.68, 1.1), (0.55, 0.68, 1.3), label)
        )
    return tube(np.array([[0, 0, 0.2], [0, 0, 0.9]]), np.array([0.19, 0.23]), label, 10)


def cabinet(random: np.random.Generator) -> Shape:
    """A switch cabinet, a parcel locker, an electricity box or a ticket machine."""
    length, w, h = random.uniform(0.4, 1.8), random.uniform(0.3, 0.6), random.uniform(0.7, 1.9)
    label = face_label(Material.PLASTIC, _OTHER)
    return join(
        box((-length / 2, -w / 2, 0), (length / 2, w / 2, h), label),
        box((-length / 2 - 0.04, -w / 2 - 0.04, h), (length / 2 + 0.04, w / 2 + 0.04, h + 0.06), label),
    )


def hydrant(random: np.random.Generator) -> Shape:
    """A hydrant of about 0.9 m."""
    label = face_label(Material.PLASTIC, _OTHER)
    return join(
        tube(np.array([[0, 0, 0], [0, 0, random.uniform(0.7, 1.0)]]), 0.11, label, 8),
        tube(np.array([[0, -0.2, 0.6], [0, 0.2, 0.6]]), 0.06, label, 6),
    )


def bike_rack(random: np.random.Generator) -> Shape:
    """One to six parked bicycles side by side."""
    count = random.integers(1, 7)
    bike = bicycle()
    parts = []
    for k in range(count):
        parts.append(
            bike.turned(random.normal(0, 0.08)).moved(
                x=random.normal(0, 0.08), y=(k - (count - 1) / 2) * random.uniform(0.5, 0.65)
            )
        )
    return join(*parts)


def motorbike(random: np.random.Generator) -> Shape:
    """A parked motorcycle or scooter."""
    metal, tyre = face_label(Material.METAL, _OTHER), face_label(Material.TYRE, _OTHER)
    reach = random.uniform(0.6, 0.75)
    parts = [tube(np.array([[x, -0.06, 0.31], [x, 0.06, 0.31]]), 0.31, tyre, 12) for x in (-reach, reach)]
    parts.append(box((-0.4, -0.16, 0.3), (0.35, 0.16, 0.75), metal))
    parts.append(box((-0.75, -0.13, 0.68), (0.0, 0.13, 0.84), metal))
    parts.append(tube(np.array([[reach, 0, 0.31], [reach - 0.3, 0, 1.05]]), 0.06, metal, 6))
    parts.append(tube(np.array([[reach - 0.32, -0.36, 1.02], [reach - 0.3, 0.36, 1.02]]), 0.025, metal, 5))
    if random.random() < 0.5:
        parts.append(box((reach - 0.35, -0.22, 0.4), (reach - 0.28, 0.22, 1.25), metal))
    return join(*parts)


def bus_stop(random: np.random.Generator) -> Shape:
    """A glass shelter with a bench, open to −y."""
    length = random.uniform(2.5, 4.5)
    metal, pane = face_label(Material.METAL, _OTHER), face_label(Material.WINDOW, _OTHER)
    parts = [
        box((x - 0.05, y - 0.05, 0), (x + 0.05, y + 0.05, 2.4), metal)
        for x in (-length / 2, 0, length / 2)
        for y in (0.0, 1.2)
    ]
    parts.append(box((-length / 2 - 0.1, -0.2, 2.4), (length / 2 + 0.1, 1.4, 2.5), metal))
    parts.append(
        quad(
            np.array(
                [[-length / 2, 1.2, 0.2], [length / 2, 1.2, 0.2], [length / 2, 1.2, 2.2], [-length / 2, 1.2, 2.2]]
            ),
            pane,
        )
    )
    parts.append(box((-length / 2 + 0.3, 0.8, 0.4), (length / 2 - 0.3, 1.15, 0.48), metal))
    return join(*parts)


def table(random: np.random.Generator) -> Shape:
    """A table with chairs, as before a cafe, or a bench."""
    label = face_label(Material.WOOD, _OTHER)
    parts = []
    if random.random() < 0.6:
        parts.append(box((-0.4, -0.4, 0.7), (0.4, 0.4, 0.75), label))
        parts.append(tube(np.array([[0, 0, 0], [0, 0, 0.7]]), 0.05, label, 6))
        for yaw in random.uniform(0, 2 * np.pi, random.integers(2, 5)):
            feet = [box((x, y, 0), (x + 0.03, y + 0.03, 0.4), label) for x in (0.56, 0.92) for y in (-0.2, 0.17)]
            seat, rest = (
                box((0.55, -0.2, 0.4), (0.95, 0.2, 0.45), label),
                box((0.92, -0.2, 0.45), (0.96, 0.2, 0.9), label),
            )
            chair = join(seat, rest, *feet)
            parts.append(chair.turned(yaw))
    else:
        parts += [box((-0.8, -0.2, 0.4), (0.8, 0.2, 0.46), label), box((-0.8, 0.2, 0.46), (0.8, 0.25, 0.9), label)]
        parts += [box((x, -0.2, 0), (x + 0.06, 0.2, 0.4), label) for x in (-0.7, 0.64)]
    return join(*parts)


def stairs(random: np.random.Generator) -> Shape:
    """Steps, a ramp wall or a planter box."""
    label = face_label(Material.CONCRETE, _OTHER)
    if random.random() < 0.5:
        w = random.uniform(0.8, 2.0)
        return join(*(box((-w, 0.3 * k, -0.2), (w, 1.5, 0.16 * (k + 1)), label) for k in range(random.integers(2, 5))))
    half, w, h = random.uniform(0.5, 1.5), random.uniform(0.3, 0.7), random.uniform(0.4, 0.8)
    return box((-half, -w, -0.1), (half, w, h), label)


def cone(random: np.random.Generator) -> Shape:
    """A traffic cone of 0.5 to 0.95 m on its foot."""
    height = random.uniform(0.5, 0.95)
    label, band = face_label(Material.PLASTIC, PointClass.CONE), face_label(Material.SIGN, PointClass.CONE)
    base = 0.21 * height + 0.06
    z = np.array([0.03, 0.4, 0.6, 0.8, 1.0]) * height
    r = np.interp(z / height, [0, 1], [0.16 * height + 0.04, 0.03])
    parts = [box((-base, -base, 0.0), (base, base, 0.035), label)]
    for k, name in enumerate((label, band, label, band)):
        parts.append(tube(np.array([[0, 0, z[k]], [0, 0, z[k + 1]]]), r[k : k + 2], name, 10))
    return join(*parts).centred()


def barrier(random: np.random.Generator) -> Shape:
    """A road-work barrier: a block of a Jersey profile, or boards on feet; its length lies along x."""
    if random.random() < 0.5:
        length, height = random.uniform(1.0, 3.0), random.uniform(0.75, 1.0)
        label = face_label(Material.CONCRETE if random.random() < 0.5 else Material.PLASTIC, PointClass.BARRIER)
        profile = np.array(
            [
                [-0.28, 0],
                [-0.28, 0.08],
                [-0.17, 0.3],
                [-0.09, height],
                [0.09, height],
                [0.17, 0.3],
                [0.28, 0.08],
                [0.28, 0],
            ]
        )
        sections = np.stack([np.concatenate([np.full((8, 1), x), profile], 1) for x in (-length / 2, length / 2)])
        return loft(sections, label, closed=True, caps=label).centred()
    length, height = random.uniform(1.2, 2.4), random.uniform(0.95, 1.15)
    label, foot = face_label(Material.SIGN, PointClass.BARRIER), face_label(Material.PLASTIC, PointClass.BARRIER)
    parts = [box((-length / 2, -0.025, height - 0.25), (length / 2, 0.025, height), label)]
    parts.append(box((-length / 2, -0.025, 0.3), (length / 2, 0.025, 0.5), label))
    for x in (-length / 2 + 0.1, length / 2 - 0.15):
        parts.append(box((x, -0.03, 0), (x + 0.05, 0.03, height), foot))
        parts.append(box((x - 0.1, -0.3, 0), (x + 0.15, 0.3, 0.08), foot))
    return join(*parts).centred()
