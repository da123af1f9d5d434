"""A child that speaks the protocol and imports next to nothing: for tests of the supervisor alone."""

import json
import os
import signal
import socket
import sys
import time

signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # by which a real child prints its stacks
behaviour = sys.argv[1]
channel = socket.socket(fileno=int(sys.argv[sys.argv.index("--channel") + 1]))


def say(report, **details):
    channel.sendall(json.dumps({"report": report, **details}).encode() + b"\n")


def orders():
    with channel.makefile("rb") as lines:
        for line in lines:
            yield json.loads(line)


if behaviour == "refuses":
    say("failed", error="x.yaml:3: components.0: wrong")
    sys.exit(2)
if behaviour == "crashes building":
    print("no such library")
    sys.exit(3)
if behaviour == "never ready":
    time.sleep(60)
if behaviour == "damaged":
    channel.sendall(b"this is no JSON\n" + b"\xff\xfe\n")
    time.sleep(60)
if behaviour == "leaves a grandchild" and os.fork() == 0:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(60)
    os._exit(0)
if behaviour.startswith("crashes once "):
    mark = behaviour.removeprefix("crashes once ")
    if not os.path.exists(mark):
        open(mark, "w").close()
        sys.exit(4)
if behaviour == "talks":
    for number in range(200):
        print(f"line {number}")
    sys.stdout.write("half a line")
    sys.stdout.flush()
say("building")
say("ready", components={"part": {"kind": "generic", "inputs": {}, "outputs": {f"topic of {os.getpid()}": "int"}}})
for order in orders():
    if order["do"] == "start":
        if behaviour in ("dies at once", "talks"):
            os.kill(os.getpid(), signal.SIGSEGV if behaviour == "talks" else signal.SIGKILL)
        if behaviour == "never starts":
            time.sleep(60)
        if behaviour == "breaks":
            say("broke", error="RuntimeError: no sensor")
            sys.exit(1)
        say("running", **({"starting": {"part": "it warms up"}} if behaviour == "warms up" else {}))
        if behaviour == "warms up":
            time.sleep(0.3)
        say("beat", hanging=["part.process at version 7 for 9.0 s"] if behaviour == "hangs" else [])
        if behaviour.startswith("listened to, notes "):
            say("beat", links={"heard": {"readers": 1}, "left": {"readers": 0}})
        if behaviour == "beats":
            import threading

            def beat():
                while True:
                    time.sleep(0.02)
                    say("beat", hanging=[])

            threading.Thread(target=beat, daemon=True).start()
        if behaviour == "silent":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if behaviour == "ends":
            sys.exit(0)
    elif order["do"] == "stop":
        if behaviour.startswith("flushes for half a second "):
            time.sleep(0.5)
            open(behaviour.removeprefix("flushes for half a second "), "w").close()
        if behaviour == "does not stop":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(60)
        say("stopped", hanging=[])
        sys.exit(0)
    elif order["do"] == "export" and behaviour != "deaf":
        if behaviour.startswith("listened to, notes "):
            with open(behaviour.removeprefix("listened to, notes "), "a") as notes:
                notes.write(f"{os.getpid()} {order['topic']}\n")
        say("answer", id=order.get("id"), ok=True)
