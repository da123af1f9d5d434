"""The corridor ahead: against the corners of boxes, computed one by one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Polygon, box

from warploom.components.messages import Obstacles
from warploom.components.node.planning import ObstacleIntake, ObstacleIntakeConfig, corridor_report
from warploom.dag import Trigger
from warploom.datamesh import CommitPolicy, DataMesh, Output, Status

CONFIG = ObstacleIntakeConfig(half_width=1.6, front=2.5, length=60.0)


def obstacles(boxes, velocities=None, version=9):
    boxes = np.asarray(boxes, np.float32).reshape(-1, 7)
    n = len(boxes)
    return Obstacles(
        version=version,
        frame=0,
        frame_id="lidar",
        velocity_reference="ego",
        ids=np.arange(10, 10 + n),
        classes=np.zeros(n, np.int32),
        scores=np.ones(n, np.float32),
        boxes=boxes,
        velocities=np.zeros((n, 2), np.float32) if velocities is None else np.asarray(velocities, np.float32),
        background=np.zeros(n, bool),
    )


def extent(x, y, length, width, yaw):
    """The upright rectangle around a turned box."""
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length / 2, width / 2]
    c, s = math.cos(yaw), math.sin(yaw)
    return box(*Polygon(corners @ np.array([[c, s], [-s, c]]) + [x, y]).bounds)


one_box = st.tuples(
    st.integers(-20, 80), st.integers(-6, 6), st.integers(1, 8), st.integers(1, 3), st.floats(-math.pi, math.pi)
)


@given(st.lists(one_box, max_size=6))
def test_what_reaches_into_the_corridor_is_what_geos_finds(rows):
    """Boxes that touch the edge of the corridor within 1 cm may fall on either side."""
    report = corridor_report(obstacles([(x, y, 0, long, wide, 1, yaw) for x, y, long, wide, yaw in rows]), CONFIG)
    corridor = box(2.5, -1.6, 62.5, 1.6)
    sure = sum(extent(*row).intersects(corridor.buffer(-0.01)) for row in rows)
    possible = sum(extent(*row).intersects(corridor.buffer(0.01, join_style="mitre")) for row in rows)
    assert sure <= report.in_corridor <= possible
    assert report.obstacles == len(rows)


def test_the_nearest_is_told_with_its_distance_and_the_time_until_it_is_met():
    ahead = [(30, 0, 0, 4, 2, 1, 0), (20, 0.5, 0, 4, 2, 1, 0), (10, 9, 0, 4, 2, 1, 0), (-8, 0, 0, 4, 2, 1, 0)]
    report = corridor_report(obstacles(ahead, [[0, 0], [-5, 0], [-50, 0], [5, 0]]), CONFIG)
    assert (report.in_corridor, report.nearest_id, report.version) == (2, 11, 9)
    assert report.nearest_m == pytest.approx(20 - 2 - 2.5)
    assert report.contact_s == pytest.approx(15.5 / 5)


@pytest.mark.parametrize("speed", [0.0, 3.0, math.nan])
def test_what_does_not_come_nearer_is_never_met(speed):
    report = corridor_report(obstacles([(20, 0, 0, 4, 2, 1, 0)], [[speed, 0]]), CONFIG)
    assert report.nearest_m < math.inf
    assert report.contact_s == math.inf


def test_no_obstacles_leave_the_way_free():
    report = corridor_report(obstacles([]), CONFIG)
    assert (report.in_corridor, report.nearest_id, report.nearest_m) == (0, -1, math.inf)


def test_each_frame_is_looked_at_once():
    mesh = DataMesh()
    intake = ObstacleIntake("intake")
    intake.bind(mesh, {"obstacles": "o", "corridor": "c"})
    intake.init(CONFIG)
    assert intake.idle_because == "no data on o yet"
    assert intake.state() == {"frames": 0}
    output = Output()
    output.bind("o", mesh.window("o"))
    with output.allocate_change() as change:
        change.set_version(9, 77)
        change.value = obstacles([(20, 0, 0, 4, 2, 1, 0)])
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
    assert intake.process(Trigger(9, 77)) is Status.OK
    assert intake.process(Trigger(8)) is Status.MISS
    entry = mesh.window("c").snapshot().entry(0)
    assert (entry.value.in_corridor, entry.received_ns) == (1, 77)
    assert intake.idle_because is None
    assert intake.state()["frames"] == 1
