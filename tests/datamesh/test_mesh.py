"""The mesh: one window a topic."""

import threading

import pytest

from warploom.datamesh import CommitPolicy, DataMesh, Entry


def test_a_topic_has_one_window():
    mesh = DataMesh(window_capacity=5)
    window = mesh.window("perception/obstacles")
    assert mesh.window("perception/obstacles") is window
    assert window.topic == "perception/obstacles"
    assert window.capacity == 5
    assert mesh.window("lidar/points", 2).capacity == 2
    assert mesh.topics() == ["lidar/points", "perception/obstacles"]


def test_a_capacity_of_zero_is_refused_not_replaced():
    with pytest.raises(ValueError, match="capacity of window 'topic'"):
        DataMesh().window("topic", 0)


def test_losses_of_all_windows_are_in_one_place():
    mesh = DataMesh()
    for topic in ("a", "b"):
        for version in (2, 1):
            mesh.window(topic).commit(CommitPolicy.DISCARD_OUT_OF_ORDER, Entry(version, None, 0, 0))
    assert mesh.losses.as_dict() == {"a": {"out_of_order": 1}, "b": {"out_of_order": 1}}


def test_threads_that_ask_at_once_get_the_same_window():
    mesh = DataMesh()
    start = threading.Barrier(8)
    got = []

    def ask():
        start.wait(10)
        got.append(mesh.window("topic"))

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert len(got) == 8
    assert len(set(map(id, got))) == 1


def test_windows_without_room_are_refused_when_the_mesh_is_made():
    with pytest.raises(ValueError, match="window_capacity must be >= 1, not 0"):
        DataMesh(0)
