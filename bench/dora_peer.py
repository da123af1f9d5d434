"""dora-rs beside the other ways of `bench_transport.py`: a dataflow of two nodes, which its daemon runs.

`python -m warploom.bench.dora_peer send|receive COUNT SIZE EVERY FILE` is one of the nodes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

__all__ = ["send_by_dora"]

PATIENCE = 60.0  # [s]
now = time.perf_counter_ns


def send_by_dora(size: int, count: int, every_s: float) -> np.ndarray:
    """Sends data from a node to another; arguments and result are those of `transport_peers.send_all`.

    Raises:
        TimeoutError: The dataflow does not end, or data are missing.
    """
    with tempfile.TemporaryDirectory() as folder:
        file, flow = Path(folder) / "times.json", Path(folder) / "flow.yml"
        node = f"path: {sys.executable}, args: -m warploom.bench.dora_peer {{}} {count} {size} {every_s} {file}"
        flow.write_text(
            "nodes:\n"
            f"  - {{id: sender, {node.format('send')}, outputs: [data]}}\n"
            f"  - {{id: receiver, {node.format('receive')}, inputs: {{data: sender/data}}}}\n"
        )
        command = [sys.executable, "-c", f"import dora; dora.run({str(flow)!r})"]
        try:
            subprocess.run(command, cwd=folder, capture_output=True, check=False, timeout=PATIENCE)
            return np.array(json.loads(file.read_text()), np.int64).reshape(-1, 2)
        except (subprocess.TimeoutExpired, FileNotFoundError) as error:
            raise TimeoutError(f"dora-rs: not all of {count} data of {size} bytes have arrived") from error


def _send(count: int, size: int, every_s: float) -> None:
    import pyarrow
    from dora import Node

    node = Node()
    source = np.arange(size // 8)
    time.sleep(2.0)  # for the receiver to be there
    for number in range(count):
        time.sleep(every_s)
        source[-1] = number
        source[:2] = now()
        node.send_output("data", pyarrow.array(source))
    time.sleep(1.0)  # what is on its way arrives


def _receive(count: int) -> list[tuple[int, int]]:
    from dora import Node

    times = []
    for event in Node():
        here = now()
        if event["type"] == "STOP":
            break
        if event["type"] == "INPUT":
            data = event["value"].to_numpy(zero_copy_only=True)
            times.append((here - int(data[0]), here - int(data[1])))
            if data[-1] == count - 1:
                break
    return times


def _main(kind: str, count: str, size: str, every_s: str, file: str) -> None:
    if kind == "send":
        _send(int(count), int(size), float(every_s))
    else:
        Path(file).write_text(json.dumps(_receive(int(count))))


if __name__ == "__main__":
    _main(*sys.argv[1:])
