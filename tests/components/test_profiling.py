"""warploom profile: what is proposed for which machine, what is measured, and what is said of it."""

import dataclasses
import json

import numpy as np
import pytest
from typer.testing import CliRunner

import warploom as wl
from warploom.cli import app
from warploom.components import profiling
from warploom.components.profile import load_profile
from warploom.components.profiling import (
    WARM_UP,
    Measurement,
    StageTimes,
    Times,
    measure_profile,
    propose,
    verdict_lines,
)

LAPTOP = {"cores": 8, "memory_gib": 16.0, "cuda": [], "inference_providers": ["CPU"], "taichi": ["cpu"]}


def gpu(name="NVIDIA GeForce RTX 4060", memory=8.0, integrated=False):
    return {"device": "cuda:0", "name": name, "memory_gib": memory, "integrated": integrated}


@pytest.mark.parametrize(
    ("machine", "profile", "reason"),
    [
        ({}, "cpu", "Warp finds no CUDA device"),
        ({"cores": 2, "memory_gib": 2.0}, "cpu-min", "less than 3 GiB"),
        ({"memory_gib": None}, "cpu", "8 cores"),
        ({"cuda": [gpu()]}, "gpu", "RTX 4060 with 8 GiB runs the kernels"),
        ({"cuda": [gpu("NVIDIA H200", 139.8)]}, "h200", "NVIDIA H200 with 139.8 GiB has room"),
        ({"cuda": [gpu("Orin", 30.0, integrated=True)]}, "orin", "shares its memory with the CPU"),
    ],
)
def test_a_profile_is_proposed_with_the_reason(machine, profile, reason):
    proposal = propose({**LAPTOP, **machine})
    assert proposal.profile == profile
    assert any(reason in text for text in proposal.reasons), proposal.reasons
    assert proposal.profile not in proposal.others


def test_what_is_missing_for_networks_on_a_gpu_is_said():
    said = propose({**LAPTOP, "cuda": [gpu()]}).reasons
    assert any("pip install onnxruntime-gpu" in text for text in said)
    ready = propose({**LAPTOP, "cuda": [gpu()], "inference_providers": ["CUDA", "CPU"]}).reasons
    assert not any("pip install" in text for text in ready)


def test_taichi_is_possible_where_it_has_a_device():
    assert "taichi-vulkan" in propose({**LAPTOP, "taichi": ["cpu", "vulkan"]}).others
    assert "taichi-cpu" in propose(LAPTOP).others
    assert not {"taichi-cpu", "taichi-vulkan"} & set(propose({**LAPTOP, "taichi": []}).others)


def test_every_profile_that_can_be_proposed_ships():
    machines = [
        LAPTOP,
        {**LAPTOP, "memory_gib": 1.0},
        *({**LAPTOP, "cuda": [one]} for one in (gpu(), gpu(memory=80.0))),
    ]
    machines.append({**LAPTOP, "cuda": [gpu(integrated=True)], "taichi": ["cpu", "vulkan"]})
    for machine in machines:
        proposal = propose(machine)
        for name in (proposal.profile, *proposal.others):
            if not name.startswith("taichi"):  # which need Taichi to be read
                assert load_profile(name).content.profile == name


def measured(total=(50.0, 80.0, 90.0), lost=0, device="cpu", **stages):
    return Measurement(
        profile="p",
        device=device,
        rate_hz=10.0,
        frames=50,
        measured=45,
        lost=lost,
        losses={},
        points=1000,
        budget_ms=100.0,
        total=None if total is None else Times(median=total[0], p95=total[1], max=total[2]),
        stages={
            name.replace("__", "."): StageTimes(wait=Times.of([wait]), run=Times.of([run]))
            for name, (wait, run) in stages.items()
        },
        prepare_s=1.0,
    )


def test_a_budget_holds_if_95_per_cent_are_within_it_and_none_is_lost():
    good = measured()
    assert good.holds
    assert good.as_dict()["holds"] is True
    assert verdict_lines(good) == [
        "the budget of 100 ms at 10 Hz holds: 95 % of 45 frames took at most 80.0 ms, and none was lost"
    ]
    assert not measured(total=(50.0, 100.1, 120.0)).holds
    assert not measured(lost=1).holds
    assert not measured(total=None).holds


def test_a_budget_that_does_not_hold_is_told_with_the_slowest_stage_and_the_way_out():
    lines = verdict_lines(
        measured((120.0, 150.0, 160.0), lost=3, perception__detect=(0.1, 110.0), perception__ground=(0.0, 5.0))
    )
    assert "does not hold" in lines[0]
    assert "3 of 50 frames were lost" in lines[0]
    assert lines[1] == "most of it is perception.detect: 110.0 ms, and 0.1 ms of waiting for it"
    assert "models.detector" in lines[2]
    assert "a GPU" in lines[2]
    assert "busy" not in lines[-1]
    late = measured((120.0, 150.0, 160.0), perception__detect=(0.1, 110.0))
    assert "load 3.2): measure again" in verdict_lines(dataclasses.replace(late, load=3.2))[-1]
    other = verdict_lines(measured((120.0, 150.0, 160.0), device="cuda:0", perception__cluster=(0.1, 110.0)))
    assert "gpu-chain" in other[2]
    assert verdict_lines(measured(total=None)) == [
        "the budget of 100 ms at 10 Hz does not hold: none of 50 frames came out"
    ]


@pytest.fixture(scope="module")
def frames():
    """A drive at the rate of the budget, with few points so that every machine keeps up."""
    drive = list(wl.read("sim:street?seed=2&duration=1.0&lidar=vlp16"))
    assert len(drive) == 10
    return drive


def test_the_drive_is_measured_stage_by_stage(frames):
    result = measure_profile("cpu", frames=frames)
    assert (result.profile, result.device, result.frames) == ("cpu", "cpu", 10)
    assert result.measured + result.lost <= 10
    assert result.measured <= 10 - WARM_UP
    assert result.points == int(np.median([len(frame.points) for frame in frames]))
    assert {"perception.filter", "perception.ground", "perception.detect", "tracking.track"} <= set(result.stages)
    for stage in result.stages.values():
        for times in (stage.wait, stage.run):
            assert 0 <= times.median <= times.p95 <= times.max
    assert result.total is not None
    # Branches run side by side, but no stage takes longer than the frame it is in.
    assert result.total.max >= max(stage.run.max for stage in result.stages.values()) * 0.999
    json.dumps(result.as_dict())


def test_too_short_a_drive_is_refused(frames):
    with pytest.raises(ValueError, match="5 frames are too few: the first 5 warm up"):
        measure_profile("cpu", frames=frames[:5])


MACHINE = {**LAPTOP, "system": "Linux", "python": "3", "processor": "p", "devices": ["cpu"], "gpus": [], "versions": {}}


def test_the_command_says_it_all_as_json(monkeypatch):
    monkeypatch.setattr(profiling, "look", lambda: MACHINE)
    asked = []

    def measure(name, **how):
        asked.append((name, how["seconds"], list(how["settings"])))
        return measured()

    monkeypatch.setattr(profiling, "measure_profile", measure)
    done = CliRunner().invoke(app, ["profile", "--json", "--seconds", "2", "--set", "a.b=1"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["proposal"]["profile"] == "cpu"
    assert told["measurement"]["holds"] is True
    assert asked == [("cpu", 2.0, ["a.b=1"])]


def test_the_command_as_text(monkeypatch):
    monkeypatch.setattr(profiling, "look", lambda: MACHINE)
    monkeypatch.setattr(profiling, "measure_profile", lambda name, **_: measured(perception__detect=(0.5, 40.0)))
    done = CliRunner().invoke(app, ["profile", "cpu-min"])
    assert done.exit_code == 0, done.output
    assert "proposed: cpu, because Warp finds no CUDA device" in done.stdout
    assert "perception.detect" in done.stdout
    assert "end to end" in done.stdout
    assert "the budget of 100 ms at 10 Hz holds" in done.stdout


def test_it_can_only_look(monkeypatch):
    monkeypatch.setattr(profiling, "look", lambda: MACHINE)

    def refuse(*_, **__):
        raise AssertionError("nothing is measured")

    monkeypatch.setattr(profiling, "measure_profile", refuse)
    done = CliRunner().invoke(app, ["profile", "--no-measure", "--json"])
    assert json.loads(done.stdout)["measurement"] is None


def test_a_profile_that_there_is_not_is_told_before_the_machine_is_looked_at(monkeypatch):
    monkeypatch.setattr(profiling, "look", lambda: pytest.fail("it takes a second"))
    for more in ([], ["--no-measure"]):
        done = CliRunner().invoke(app, ["profile", "cup", *more])
        assert "no profile 'cup'" in str(done.exception)
        assert "did you mean 'cpu'?" in str(done.exception)


def test_its_help_shows_an_example():
    assert "warploom profile --seconds 10" in CliRunner().invoke(app, ["profile", "--help"]).stdout
