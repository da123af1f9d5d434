"""The control plane: what a client may send, and what it must not break."""

import asyncio
import json
import os
import socket
import stat

import pytest

from warploom.dag.launch.control import ControlClient, ControlServer, connect
from warploom.errors import ConfigError, WarploomError


@pytest.fixture
def serve(tmp_path):
    """Runs a scenario in a thread beside a server."""

    def serve(scenario, answers=None):
        path = tmp_path / "c.sock"

        async def echo(request):
            return dict(request)

        async def refuse(request):
            raise ConfigError("not today")

        async def late(request):
            raise TimeoutError

        async def run():
            server = ControlServer(path, {"echo": echo, "refuse": refuse, "late": late, **(answers or {})})
            await server.open()
            try:
                return await asyncio.to_thread(scenario, path, server)
            finally:
                await server.close()

        return asyncio.run(run())

    return serve


def raw(path, data, lines=1):
    with socket.socket(socket.AF_UNIX) as one:
        one.settimeout(10)
        one.connect(str(path))
        one.sendall(data)
        with one.makefile("rb") as answers:
            return [answers.readline() for _ in range(lines)]


def test_a_request_is_answered_with_its_number(serve):
    def scenario(path, _):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        with ControlClient(path) as client:
            assert client.ask("echo", topic="a")["topic"] == "a"
            with pytest.raises(WarploomError, match="not today"):
                client.ask("refuse")
            with pytest.raises(WarploomError, match="gave no answer in time"):
                client.ask("late")
            assert client.ask("echo", x=1)["x"] == 1
        return raw(path, b'{"request": "echo", "id": "mine"}\n')

    assert json.loads(serve(scenario)[0])["id"] == "mine"


def test_a_client_knows_when_the_supervisor_has_gone_away(serve):
    clients = []

    def scenario(path, _):
        clients.append(ControlClient(path))
        assert clients[0].ask("echo", x=1)["x"] == 1
        assert not clients[0].ended

    serve(scenario)
    with clients[0] as client:
        assert client.ended


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"nonsense\n", "not a line of JSON"),
        (b"[1, 2]\n", 'expected an object with a key "request"'),
        (b'{"request": 5}\n', 'expected an object with a key "request"'),
        (b'{"request": "ech"}\n', "no request 'ech'; did you mean 'echo'? known: echo, late, refuse, watch"),
        (b"\xff\xfe\n", "not a line of JSON"),
    ],
)
def test_a_bad_line_is_refused_and_the_next_one_answered(serve, line, expected):
    first, second = serve(lambda path, _: raw(path, line + b'{"request": "echo"}\n', lines=2))
    assert expected in json.loads(first)["error"]
    assert json.loads(second)["ok"]


def test_a_line_without_end_costs_its_connection_alone(serve):
    def scenario(path, _):
        with socket.socket(socket.AF_UNIX) as one:
            one.settimeout(10)
            one.connect(str(path))
            try:
                for _ in range(100):
                    one.sendall(b"x" * 10_000)
                assert one.recv(1) == b""
            except (BrokenPipeError, ConnectionResetError):
                pass
        with ControlClient(path) as client:
            assert client.ask("echo")

    serve(scenario)


def test_who_watches_and_does_not_read_is_cut_off(serve):
    def scenario(path, server):
        loop = server._server.get_loop()
        with socket.socket(socket.AF_UNIX) as one:
            one.settimeout(10)
            one.connect(str(path))
            one.sendall(b'{"request": "watch"}\n')
            assert json.loads(one.recv(100))["ok"]

            async def flood():
                for _ in range(100):
                    server.tell({"event": "x" * 100_000})
                    await asyncio.sleep(0)
                return len(server._watching)

            assert asyncio.run_coroutine_threadsafe(flood(), loop).result(20) == 0

    serve(scenario)


def test_nobody_there_is_told(tmp_path):
    with pytest.raises(ConfigError, match="no supervisor answers there"):
        ControlClient(tmp_path / "none.sock")


def test_a_socket_that_cannot_be_made_is_told(tmp_path):
    server = ControlServer(tmp_path / "none" / "c.sock", {})
    with pytest.raises(ConfigError, match="the control socket cannot be made"):
        asyncio.run(server.open())


def test_who_may_not_look_into_the_folder_of_the_nodes_is_told_so(run_base, monkeypatch):
    run_base.mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: path != run_base)
    with pytest.raises(ConfigError, match="is not readable for this user: ask as the user who runs the node"):
        connect()


def test_a_supervisor_that_went_away_between_two_questions_has_ended(serve):
    clients = []

    def scenario(path, server):
        clients.append(ControlClient(path))
        assert clients[0].ask("echo")["request"] == "echo"

    serve(scenario)
    with clients[0] as client:
        for _ in range(2):  # the first finds the end of the answers or a reset, the second nobody to write to
            with pytest.raises(WarploomError, match="the supervisor has ended"):
                client.ask("echo")
