"""Backlogs: bounded, with every drop counted. Threads meet by events; nothing is measured."""

import threading

import pytest
from pydantic import ValidationError

from warploom.dag import BacklogConfig, Trigger
from warploom.dag.backlog import Backlog
from warploom.datamesh import LossCounters


def make(**config):
    losses = LossCounters()
    return Backlog("component", BacklogConfig(**config), losses), losses


def fill(backlog, versions):
    """What each offer dropped."""
    dropped = [backlog.offer(Trigger(version)) for version in versions]
    return [trigger and trigger.version for trigger in dropped]


def drain(backlog):
    backlog.close()
    return [trigger.version for trigger in iter(backlog.take, None)]


def test_latest_keeps_the_newest_whatever_depth_is_said():
    backlog, losses = make(policy="latest", depth=5)
    assert fill(backlog, [1, 2, 3]) == [None, 1, 2]
    assert drain(backlog) == [3]
    assert losses.as_dict() == {"component": {"backlog": 2}}


def test_fifo_drops_the_oldest():
    backlog, losses = make(policy="fifo", depth=2)
    assert fill(backlog, [1, 2, 3, 4]) == [None, None, 1, 2]
    assert drain(backlog) == [3, 4]
    assert losses["component", "backlog"] == 2


def test_fifo_drops_the_newest():
    backlog, losses = make(policy="fifo", depth=2, drop="newest")
    assert fill(backlog, [1, 2, 3, 4]) == [None, None, 3, 4]
    assert drain(backlog) == [1, 2]
    assert losses["component", "backlog"] == 2


def test_block_waits_for_room_and_loses_nothing():
    backlog, losses = make(policy="block", depth=2)
    producer = threading.Thread(target=fill, args=(backlog, range(50)))
    producer.start()
    assert [backlog.take().version for _ in range(50)] == list(range(50))
    producer.join(10)
    assert losses.as_dict() == {}


def test_block_never_holds_more_than_its_depth():
    backlog, _ = make(policy="block", depth=3)
    fill(backlog, [1, 2, 3])
    producer = threading.Thread(target=fill, args=(backlog, [4]))
    producer.start()
    producer.join(0.05)
    assert producer.is_alive()
    assert len(backlog.waiting) == 3
    backlog.take()
    producer.join(10)
    assert not producer.is_alive()


def test_close_frees_a_producer_that_waits_and_counts_its_frame():
    backlog, losses = make(policy="block", depth=1)
    fill(backlog, [1])
    dropped = []
    producer = threading.Thread(target=lambda: dropped.extend(fill(backlog, [2])))
    producer.start()
    producer.join(0.05)
    backlog.close()
    producer.join(10)
    assert dropped == [2]
    assert drain(backlog) == [1]
    assert losses.as_dict() == {"component": {"shutdown": 1}}


def test_close_frees_a_consumer_that_waits():
    backlog, _ = make()
    taken = []
    consumer = threading.Thread(target=lambda: taken.append(backlog.take()))
    consumer.start()
    backlog.close()
    consumer.join(10)
    assert taken == [None]


@pytest.mark.parametrize("policy", ["latest", "fifo", "block"])
def test_a_closed_backlog_takes_nothing_more(policy):
    backlog, losses = make(policy=policy)
    backlog.close()
    assert fill(backlog, [1]) == [1]
    assert backlog.take() is None
    assert losses["component", "shutdown"] == 1


@pytest.mark.parametrize("config", [{}, {"policy": "fifo", "drop": "newest"}, {"policy": "block"}])
def test_settled_versions_keep_their_turn_and_take_no_room(config):
    backlog, losses = make(**config)
    for version in (1, 3):
        assert backlog.offer(Trigger(version, settled=True)) is None
        assert backlog.offer(Trigger(version + 1)) is None if version == 1 else True
    assert drain(backlog) == [1, 2, 3]
    assert losses.as_dict() == {}


def test_a_settled_version_is_never_the_one_that_is_dropped():
    backlog, _ = make(policy="latest")
    backlog.offer(Trigger(1, settled=True))
    assert fill(backlog, [2, 3]) == [None, 2]
    assert drain(backlog) == [1, 3]


@pytest.mark.parametrize("config", [{"depth": 0}, {"policy": "lifo"}, {"drop": "middle"}, {"size": 3}])
def test_a_configuration_that_makes_no_sense_is_refused(config):
    with pytest.raises(ValidationError):
        BacklogConfig(**config)


def test_settled_versions_that_wait_are_bounded_and_the_oldest_are_given_back_to_be_settled():
    backlog, losses = make()
    backlog.offer(Trigger(0))
    given_back = [backlog.offer(Trigger(version, settled=True)) for version in range(1, 1001)]
    assert [one.version for one in given_back if one is not None] == list(range(1, 1001 - 256))
    assert drain(backlog) == [0, *range(1001 - 256, 1001)]
    assert losses.as_dict() == {}


def test_a_backlog_that_was_closed_opens_again():
    backlog, losses = make(policy="fifo", depth=3)
    fill(backlog, [1])
    backlog.close()
    assert fill(backlog, [2]) == [2]
    backlog.open()
    assert fill(backlog, [3]) == [None]
    assert drain(backlog) == [1, 3]
    assert losses.as_dict() == {"component": {"shutdown": 1}}


def test_take_now_does_not_wait():
    backlog, _ = make()
    assert backlog.take_now() is None
    backlog.offer(Trigger(1))
    assert len(backlog) == 1
    assert backlog.take_now().version == 1
    assert not backlog


@pytest.mark.parametrize("policy", ["fifo", "block"])
def test_several_threads_offer_and_take_without_a_loss_or_a_sleep_too_long(policy):
    backlog, losses = make(policy=policy, depth=400 if policy == "fifo" else 3)
    taken = [[] for _ in range(3)]

    def take(number):
        while (trigger := backlog.take()) is not None:
            taken[number].append(trigger.version)

    consumers = [threading.Thread(target=take, args=(number,)) for number in range(3)]
    producers = [threading.Thread(target=fill, args=(backlog, range(n, 400, 4))) for n in range(4)]
    for thread in (*consumers, *producers):
        thread.start()
    for thread in producers:
        thread.join(20)
    backlog.close()
    for thread in consumers:
        thread.join(20)
    assert sorted(version for versions in taken for version in versions) == list(range(400))
    assert losses.as_dict() == {}


def test_a_closed_backlog_gives_back_what_is_settled_and_counts_no_loss():
    backlog, losses = make()
    backlog.close()
    trigger = Trigger(1, settled=True)
    assert backlog.offer(trigger) is trigger
    assert losses.as_dict() == {}


def test_who_takes_a_frame_is_told_and_settled_versions_are_none():
    backlog, told = make(policy="fifo", depth=4)[0], []
    backlog.on_taken = lambda trigger: told.append(trigger.version)
    fill(backlog, [1])
    backlog.offer(Trigger(2, settled=True))
    fill(backlog, [3])
    assert [backlog.take().version, backlog.take_now().version, backlog.take_now().version] == [1, 2, 3]
    assert backlog.take_now() is None
    assert told == [1, 3]


def test_one_that_gives_way_takes_more_than_it_has_room_for_and_loses_nothing():
    losses = LossCounters()
    backlog = Backlog("component", BacklogConfig(policy="block"), losses)
    gives_way = []
    backlog.gives_way = lambda: bool(gives_way)
    backlog.offer(Trigger(0))
    producer = threading.Thread(target=lambda: [backlog.offer(Trigger(version)) for version in range(1, 4)])
    producer.start()
    producer.join(0.05)
    assert producer.is_alive(), "there is no room"
    gives_way.append(True)
    backlog.look_again()
    producer.join(10)
    assert not producer.is_alive()
    assert [trigger.version for trigger in backlog.waiting] == [0, 1, 2, 3]
    gives_way.clear()
    producer = threading.Thread(target=backlog.offer, args=(Trigger(4),))
    producer.start()
    taken = [backlog.take().version for _ in range(5)]
    producer.join(10)
    assert taken == [0, 1, 2, 3, 4]
    assert losses.as_dict() == {}
