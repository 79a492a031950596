"""MQTT: the cost of cells with 20 to 4000 REALs, all of which move at 50 Hz, for each way to publish them.

``told`` is the percentage of changes that were sent. The others came too fast: they were merged into newer values, or
omitted by a rate limit of the rule. One subscriber receives everything, as a dashboard would.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common import begin, table
from mqtt import PERIOD_S, segment

from shmio.config import Address, Mqtt, MqttTopic, Sparkplug
from shmio.endpoints.mqtt.bridge import Bridge
from shmio.layout.model import Layout, Register
from shmio.segment import Segment
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port

SIZES = (20, 200, 1000, 4000)
A_STRUCTURE = 100
"""Registers in each structure."""
NOTHING = MqttTopic(match="**", publish=False)
WAYS: Mapping[str, Mapping[str, Any]] = {
    "text": {},
    "text, max_rate_hz = 2": {"topic": [MqttTopic(match="**", max_rate_hz=2)]},
    "structure": {"topic": [MqttTopic(match="cell/*", payload="structure")]},
    "structure, max_rate_hz = 5": {"topic": [MqttTopic(match="cell/*", payload="structure", max_rate_hz=5)]},
    "frames": {"topic": [MqttTopic(match="cell", payload="frames"), NOTHING]},
    "Sparkplug": {"topic": [NOTHING], "sparkplug": Sparkplug(group="bench")},
}
PARTS = {"text": 1, "structure": A_STRUCTURE}
"""The most changes that one message carries. For ways that are not listed, a message carries all changes of a frame."""


def moving(count: int) -> Layout:
    registers = (Register(f"part{i // A_STRUCTURE}/v{i}", "REAL", (), 4 * i, None, 4, 1) for i in range(count))
    return Layout("CELL", None, 4 * count, False, tuple(registers))


def cost(made: Segment, address: Address, count: int, way: str, duration_s: float) -> tuple[float, float, float]:
    """Return messages a second, the percentage of the changes that they carried, and the percentage of a core used."""
    writer, stop = made.writer("cell"), threading.Event()
    images = [struct.pack(f">{count}f", *(0.001 * cycle + place for place in range(count))) for cycle in range(100)]
    settings = Mqtt(broker="external", host=str(address), prefix="bench", **WAYS[way])
    writer.publish(images[0], cycle=1)
    running = Bridge(made, made.processes.find("mqtt"), settings)
    links = 2 if "sparkplug" in WAYS[way] else 1
    while running.counters[6] < links or running.outbox.busy or running.connection.in_flight:
        running.run_once()
    frames = 0

    def publish() -> None:
        nonlocal frames
        while not stop.wait(PERIOD_S):
            frames += 1
            writer.publish(images[frames % len(images)], cycle=frames + 1)

    publishing = threading.Thread(target=publish)
    publishing.start()
    sent, begun_s, used_s = running.counters[0], time.perf_counter(), time.thread_time()
    while (passed_s := time.perf_counter() - begun_s) < duration_s:
        running.run_once()
    sent, used_s = running.counters[0] - sent, time.thread_time() - used_s
    stop.set()
    publishing.join()
    running.close()
    tells = PARTS.get(way.split(",", maxsplit=1)[0], count)
    return sent / passed_s, min(100.0, 100 * sent * min(tells, count) / (frames * count)), 100 * used_s / passed_s


def main() -> None:
    quick = begin("MQTT: what large cells cost, by how they are published")
    if reason := missing():
        raise SystemExit(reason)
    if shutil.which("mosquitto_sub") is None:
        raise SystemExit("mosquitto_sub is not installed: apt-get install mosquitto-clients")
    rows = []
    with tempfile.TemporaryDirectory() as folder, reserved_port() as address:
        broker = Mosquitto(Path(folder), address, "allow_anonymous true", "max_inflight_messages 1000")
        broker.start()
        host = ["-h", address.host, "-p", str(address.port)]
        listener = subprocess.Popen(["mosquitto_sub", *host, "-t", "#", "-q", "1"], stdout=subprocess.DEVNULL)
        try:
            for count in SIZES[:2] if quick else SIZES:
                for way in WAYS:
                    with segment(moving(count)) as made:
                        found = cost(made, address, count, way, 0.3 if quick else 5.0)
                    rows.append([f"{count} registers, {way}", *(f"{value:.0f}" for value in found)])
        finally:
            listener.kill()
            listener.wait()
            broker.stop()
    table(["all change at 50 Hz", "messages/s", "% told", "% of a core"], rows)


if __name__ == "__main__":
    main()
