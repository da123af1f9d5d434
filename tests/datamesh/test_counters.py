"""Loss counters: every loss is counted and told."""

import logging
import threading

from warploom.datamesh import LossCounters


def test_counts_by_place_and_reason():
    losses = LossCounters()
    losses.count("b", "backlog", 3)
    losses.count("a", "failed", 1)
    losses.count("b", "backlog", 4, amount=2)
    assert losses["b", "backlog"] == 3
    assert losses["b", "failed"] == 0
    assert losses.as_dict() == {"a": {"failed": 1}, "b": {"backlog": 3}}


def test_a_look_at_a_count_does_not_make_one():
    losses = LossCounters()
    assert losses["a", "failed"] == 0
    assert losses.as_dict() == {}


def test_callbacks_are_told_of_place_reason_and_version():
    losses = LossCounters()
    told = []
    losses.on_loss(lambda *loss: told.append(loss))
    losses.count("topic", "evicted", 17)
    assert told == [("topic", "evicted", 17)]


def test_a_callback_that_raises_is_logged_and_disturbs_nobody(caplog):
    losses = LossCounters()
    told = []

    def fail(*loss):
        raise RuntimeError("no disk")

    losses.on_loss(fail)
    losses.on_loss(lambda *loss: told.append(loss))
    with caplog.at_level(logging.ERROR):
        losses.count("topic", "backlog", 1)
    assert told == [("topic", "backlog", 1)]
    assert "no disk" in caplog.text


def test_a_callback_may_count_and_look():
    losses = LossCounters()
    losses.on_loss(lambda place, reason, version: reason == "first" and losses.count(place, "second", version))
    losses.count("topic", "first")
    assert losses.as_dict() == {"topic": {"first": 1, "second": 1}}


def test_no_count_is_lost_between_threads():
    losses = LossCounters()
    threads = [
        threading.Thread(target=lambda: [losses.count("topic", "backlog") for _ in range(500)]) for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert losses["topic", "backlog"] == 4000
