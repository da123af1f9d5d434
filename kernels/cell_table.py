"""A cloud's points by cell, for many threads at once: a hash table of cells, and the points of each side by side.

The cells are numbered by their lowest point, whatever the order in which threads run. See `cell_pairs.py` for what a
cell is.
"""

from __future__ import annotations

import warp as wp

from .cell_pairs import Radius, cell_of, differ, find, hash_cell, is_finite
from .device import DEFAULT_DEVICE

__all__ = ["CellTable", "cell_at", "free_slot"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_NO_POINT = wp.constant(wp.int32(2**31 - 1))


@wp.func
def free_slot(
    slot: int, table: wp.array(dtype=wp.int32), lowest: wp.array(dtype=wp.int32), size: wp.array(dtype=wp.int32)
):
    """Leaves a slot as the next launch wants to find it."""
    table[slot] = -1
    lowest[slot] = _NO_POINT
    size[slot] = 0


@wp.func
def cell_at(
    wanted: wp.vec3i,
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
) -> int:
    """The number of a cell, or -1 where it has no points."""
    mask = table.shape[0] - 1
    slot = hash_cell(wanted) & mask
    cell = int(-1)
    if table[slot] >= 0:
        cell = cell_of_slot[slot]
    while cell >= 0 and differ(cells[cell], wanted):
        slot = (slot + 1) & mask
        cell = -1
        if table[slot] >= 0:
            cell = cell_of_slot[slot]
    return cell


@wp.kernel
def _claim_cells(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: Radius,
    # in out: a table of points that stand for their cells, -1 where free; lowest points and sizes
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    # out
    slot_of_point: wp.array(dtype=wp.int32),
    cell_size: wp.array(dtype=wp.int32),
):
    """Finds each point's slot in the table, which whichever point comes first claims for the cell."""
    i = wp.tid()
    slot_of_point[i] = -1
    cell_size[i] = 0
    if i >= count_in[0]:
        return
    point = xyz_in[i]
    if not is_finite(point):
        return
    if has_include != 0 and include_in[i] == wp.uint8(0):
        return
    cell = cell_of(point, radius)
    mask = table.shape[0] - 1
    slot = hash_cell(cell) & mask
    found = wp.atomic_cas(table, slot, -1, i)
    while found >= 0 and differ(cell_of(xyz_in[wp.max(found, 0)], radius), cell):
        slot = (slot + 1) & mask
        found = wp.atomic_cas(table, slot, -1, i)
    slot_of_point[i] = slot
    wp.atomic_min(lowest, slot, i)
    wp.atomic_add(size, slot, 1)


@wp.kernel
def _mark_lowest(
    # in
    slot_of_point: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    # out
    head_out: wp.array(dtype=wp.int32),
):
    """Marks the lowest point of each cell."""
    i = wp.tid()
    head = int(0)
    slot = slot_of_point[i]
    if slot >= 0 and lowest[slot] == i:
        head = 1
    head_out[i] = head


@wp.kernel
def _number_cells(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    slot_of_point: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    radius: Radius,
    # out
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_size: wp.array(dtype=wp.int32),
    left: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
):
    """Numbers the cells by their lowest point; each is a component by itself."""
    i = wp.tid()
    if i == head_in.shape[0] - 1:
        cell_count[0] = rank_in[i]
    if head_in[i] == 0:
        return
    slot = slot_of_point[i]
    c = rank_in[i] - 1
    cell_of_slot[slot] = c
    cells[c] = cell_of(xyz_in[i], radius)
    cell_size[c] = size[slot]
    left[c] = size[slot]
    parent[c] = c
    members[c] = 0


@wp.kernel
def _scatter_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    slot_of_point: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    cell_begin: wp.array(dtype=wp.int32),
    # in out: how many points of each cell have no place yet
    left: wp.array(dtype=wp.int32),
    # out
    points: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=wp.int32),
):
    """Lists the points of each cell, in any order: whether two cells touch does not hang on it."""
    i = wp.tid()
    slot = slot_of_point[i]
    if slot >= 0:
        c = cell_of_slot[slot]
        place = cell_begin[c] + wp.atomic_sub(left, c, 1) - 1
        points[place] = xyz_in[i]
        if index:
            index[place] = i


@wp.kernel
def _count_members(
    # in
    cell_size: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    # in out
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
):
    c = wp.tid()
    if c < cell_count[0]:
        wp.atomic_add(members, find(parent, c), cell_size[c])


@wp.kernel
def _mark_clusters(
    # in
    members: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    min_size: int,
    # out
    head_out: wp.array(dtype=wp.int32),
):
    """Marks the root cells of components with enough points."""
    c = wp.tid()
    head = int(0)
    if c < cell_count[0] and parent[c] == c and members[c] >= min_size:
        head = 1
    head_out[c] = head


@wp.kernel
def _label_points(
    # in
    slot_of_point: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    # in out: paths may be halved; the table is left free
    parent: wp.array(dtype=wp.int32),
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """Hands each point the number of its component."""
    i = wp.tid()
    if i == head_in.shape[0] - 1:
        cluster_count_out[0] = rank_in[i]
    label = int(-1)
    slot = slot_of_point[i]
    if slot >= 0:
        root = find(parent, cell_of_slot[slot])
        if head_in[root] == 1:
            label = rank_in[root] - 1
        free_slot(slot, table, lowest, size)
    labels_out[i] = label


class CellTable:
    """Workspace to sort clouds of up to `capacity` points into cells; what is in it is for kernels to read."""

    def __init__(self, radius: Radius, capacity: int, device: str = DEFAULT_DEVICE, *, indexed: bool = False):
        """Makes it.

        Args:
            radius: What the side of the cells follows from.
            capacity: Points that one launch can take.
            device: A Warp device.
            indexed: Whether to list the points' indices beside their positions.
        """
        slots = 2 << (capacity - 1).bit_length()

        def buffer(length: int = capacity, dtype: type = wp.int32) -> wp.array:
            return wp.empty(length, dtype=dtype, device=device)

        self.radius = radius
        self.table = wp.full(slots, -1, dtype=wp.int32, device=device)
        """In a slot that is taken a point of its cell, else -1."""
        self.lowest = wp.full(slots, 2**31 - 1, dtype=wp.int32, device=device)
        """The lowest point of a slot's cell."""
        self.size = wp.zeros(slots, dtype=wp.int32, device=device)
        self.cell_of_slot = buffer(slots)
        self.slot_of_point = buffer()
        """-1 for points that are left out."""
        self.cell_count = wp.zeros(1, dtype=wp.int32, device=device)
        self.cells = buffer(dtype=wp.vec3i)
        self.cell_size = buffer()
        """Zero from `cell_count` on."""
        self.cell_begin = buffer()
        """Where a cell's points begin in `points` and `index`."""
        self.points = buffer(dtype=wp.vec3)
        self.index = buffer() if indexed else None
        self.parent = buffer()
        """Of each cell itself, to begin with."""
        self.members = buffer()
        """Zero, to begin with."""
        self.head = buffer()
        """For the use of whoever needs a mark per point, and `rank` for its inclusive sums."""
        self.rank = buffer()
        self._left = buffer()

    @property
    def slots(self) -> list[wp.array]:
        """What `free_slot` clears."""
        return [self.table, self.lowest, self.size]

    def launch(self, xyz: wp.array, count: wp.array, include: wp.array, has_include: int) -> None:
        """Fills everything from n > 0 points; every slot must be free, and slots are not freed."""
        n, device = xyz.shape[0], xyz.device
        slot_of_point, head, rank = self.slot_of_point[:n], self.head[:n], self.rank[:n]
        cell_size = self.cell_size[:n]

        def run(kernel: wp.Kernel, inputs: list, outputs: list) -> None:
            wp.launch(kernel, n, inputs=inputs, outputs=outputs, device=device)

        run(_claim_cells, [xyz, count, include, has_include, self.radius], [*self.slots, slot_of_point, cell_size])
        run(_mark_lowest, [slot_of_point, self.lowest], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        run(
            _number_cells,
            [xyz, slot_of_point, head, rank, self.size, self.radius],
            [self.cell_of_slot, self.cells, cell_size, self._left, self.parent, self.members, self.cell_count],
        )
        wp.utils.array_scan(cell_size, self.cell_begin[:n], inclusive=False)
        run(
            _scatter_points,
            [xyz, slot_of_point, self.cell_of_slot, self.cell_begin],
            [self._left, self.points, self.index],
        )

    def label(self, n: int, min_size: int, labels: wp.array, cluster_count: wp.array) -> None:
        """Numbers the components that `parent` tells, by their lowest point, labels the points and frees the slots.

        Args:
            n: Points of the launch before, > 0.
            min_size: Points that a component must have to get a number; the points of others get -1.
            labels: Out: shape (n or more,), int32.
            cluster_count: Out: shape (1,), int32.
        """
        head, rank, parent = self.head[:n], self.rank[:n], self.parent

        def run(kernel: wp.Kernel, inputs: list, outputs: list) -> None:
            wp.launch(kernel, n, inputs=inputs, outputs=outputs, device=labels.device)

        run(_count_members, [self.cell_size, self.cell_count], [parent, self.members])
        run(_mark_clusters, [self.members, self.cell_count, parent, min_size], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        run(
            _label_points,
            [self.slot_of_point[:n], self.cell_of_slot, head, rank],
            [parent, *self.slots, labels, cluster_count],
        )
