"""Topics of ROS 2, over loopback: how long an image takes, and how late poses are beside files.

Publisher and receiver are two processes. `image_ms`: from before an image is encoded to its pixels
as an array. `files` is `recon live` on the recording, `ros2` the same drive as topics;
`latency_ms` is from an image that was due, or had arrived, to its pose. `to_listener_ms` is from
the stamp of an image to the odometry of it in a third process.

Example: python benchmarks/ros2.py DRIVE --json
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event, Thread
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.io.ros.contents import levels_of, stamp_ns
from recon.io.ros.dds import Network, NetworkTopic
from recon.io.ros.messages import header

IMAGES = 200
SIZE = (375, 1242)  # of KITTI
IMAGE = NetworkTopic("/benchmark", "sensor_msgs/msg/Image", reliable=True)
ODOMETRY = NetworkTopic("/odometry", "nav_msgs/msg/Odometry", reliable=True)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    if options.send:
        send()
        return
    os.environ["ROS_DOMAIN_ID"] = str(100 + os.getpid() % 100)
    result: dict[str, Any] = {"image_bytes": SIZE[0] * SIZE[1], "image_ms": image_ms()}
    with tempfile.TemporaryDirectory() as folder:
        played = [str(options.drive), "--rate", "1", "--out", f"{folder}/files"]
        result["files"] = ended(subprocess.Popen(recon_live(played), **PIPED))
        result["ros2"] = over_network(options.drive, Path(folder) / "ros2", options.play)
    print(json.dumps(result, indent=2) if options.json else result)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path, nargs="?", help="a drive")
    parser.add_argument("--play", nargs="*", default=[], help="options of the player, without --")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--send", action="store_true", help="send images to another process")
    return parser.parse_args(arguments)


PIPED: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}


def recon_live(words: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "recon", "live", *words, "--json", "--no-mesh"]


def ended(process: subprocess.Popen[str]) -> dict[str, Any]:
    """What a run says of itself when it ends, and its processor time with what it started."""
    before_s = processor_s()
    said, told = process.communicate(timeout=600)
    if process.returncode:
        raise SystemExit(told)
    summary = json.loads(said)
    own = {"cores": round((processor_s() - before_s) / summary["seconds"], 2)}
    return {**summary["live"], **own, "peak_memory_mb": summary["peak_memory_mb"]}


def processor_s() -> float:
    """Processor time of all processes that this one started, and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def over_network(drive: Path, out: Path, play: Sequence[str]) -> dict[str, Any]:
    """Play a drive, read it, and listen to what comes of it."""
    late_ms, over = list[float](), Event()
    ear = Thread(target=listen, args=(late_ms, over))
    ear.start()
    words = [sys.executable, "-m", "tests.scenery.ros2_player", str(drive)]
    words += ["--stand", "/diagnostics", *(f"--{one}" for one in play)]
    player = subprocess.Popen(words, stderr=subprocess.DEVNULL)
    live = subprocess.Popen(recon_live(["ros2:", "--out", str(out)]), **PIPED)
    player.wait(timeout=300)
    time.sleep(1.0)
    live.send_signal(signal.SIGINT)
    found = ended(live)
    over.set()
    ear.join()
    return {**found, "to_listener_ms": percentiles(late_ms)}


def listen(late_ms: list[float], over: Event) -> None:
    """Note how long after the stamp of its image each odometry is here."""
    network = Network()
    network.subscribe(ODOMETRY)
    for messages in network.receive(over.is_set):
        now_ns = time.time_ns()
        late_ms += [1e-6 * (now_ns - stamp_ns(one.parse())) for one in messages]
    network.close()


def image_ms() -> dict[str, float]:
    """How long images take from one process to another."""
    sender = subprocess.Popen([sys.executable, __file__, "--send"])
    network, late_ms = Network(), list[float]()
    network.subscribe(IMAGE)
    for messages in network.receive(lambda: sender.poll() is not None):
        for one in messages:
            message = one.parse()
            pixels = levels_of(message, one.topic)
            late_ms.append(1e-6 * (time.time_ns() - stamp_ns(message)))
            if pixels.shape != SIZE:
                raise SystemExit(f"got {pixels.shape}")
    network.close()
    return percentiles(late_ms[IMAGES // 10 :])


def send() -> None:
    """Send images, 30 a second."""
    network = Network()
    pixels = np.random.default_rng(0).integers(0, 255, SIZE, dtype=np.uint8)
    size = {"height": SIZE[0], "width": SIZE[1], "step": SIZE[1], "encoding": "mono8"}
    time.sleep(1.0)
    for _ in range(IMAGES):
        content = {"header": header("left", time.time_ns()), **size, "data": pixels.reshape(-1)}
        network.write(IMAGE.name, 0, (IMAGE.kind, content))
        time.sleep(1 / 30)
    time.sleep(0.5)
    network.close()


def percentiles(values: Sequence[float]) -> dict[str, float]:
    found = np.percentile(values, [50, 95, 100]).round(2).tolist()
    return dict(zip(("p50", "p95", "max"), found, strict=True))


if __name__ == "__main__":
    main()
