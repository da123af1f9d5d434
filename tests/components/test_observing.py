"""What a run shows of itself: the pipeline's trace, metrics and their endpoint."""

import json
import threading
import urllib.error
import urllib.request

import pytest

import warploom as wl
from warploom.components.observing import MetricsServer, Observer
from warploom.components.pipeline import OBSTACLES_TOPIC
from warploom.errors import ConfigError


def get(port: int, path: str) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=20) as answer:
        return answer.read().decode()


def test_a_run_is_traced_and_measured_from_the_sensor_to_the_obstacles(tmp_path):
    street = list(wl.read("sim:street?seed=3&duration=0.5"))
    with wl.Pipeline.from_profile("cpu") as pipeline:
        with Observer(pipeline, trace=tmp_path / "trace.json", metrics_port=0) as observer:
            frames = list(pipeline.run(street, watch=observer.watch))
            text = get(observer.server.port, "/metrics")
        latency = observer.metrics.latency[OBSTACLES_TOPIC]
        assert latency.count == len(frames) == 5
        # The same latency that each frame tells, within a histogram's two percent.
        assert latency.max == pytest.approx(max(frame.latency.total_ms for frame in frames))
        median = sorted(frame.latency.total_ms for frame in frames)[2]
        assert latency.quantile(0.5) == pytest.approx(median, rel=0.0201)
        assert f'warploom_commits_total{{topic="{OBSTACLES_TOPIC}"}} 5' in text.splitlines()
        assert 'warploom_vertex_runs_total{vertex="tracking.track",status="ok"} 5' in text.splitlines()
    events = json.loads((tmp_path / "trace.json").read_text())
    tracks = [event for event in events if event["ph"] == "X" and event["name"] == "tracking.track"]
    assert [event["args"]["version"] for event in tracks] == [frame.version for frame in frames]
    flows = {event["id"] for event in events if event["ph"] == "s"}
    assert flows == {event["id"] for event in events if event["ph"] == "f"}
    assert len(flows) == 5


def test_the_endpoint_answers_on_this_machine_alone_and_ends():
    before = set(threading.enumerate())
    server = MetricsServer(0, lambda: "a 1\n")
    try:
        assert get(server.port, "/metrics") == "a 1\n"
        assert server._server.server_address[0] == "127.0.0.1"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get(server.port, "/secret")
        with pytest.raises(ConfigError, match=f"port {server.port} cannot be used for metrics"):
            MetricsServer(server.port, lambda: "")
    finally:
        server.close()
    assert not [thread for thread in set(threading.enumerate()) - before if thread.name == "metrics"]
