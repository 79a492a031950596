"""MQTT: shmio's bridge compared with a bare paho publisher of the same topics and payloads, on the same mosquitto.

Both send as fast as the broker acknowledges, from one thread. Two further figures are for frames of DB201 at 50 Hz in
which 20 REALs move: the time from a frame to the arrival of its value at a subscriber in another process, and the
bridge's share of a core.
"""

from __future__ import annotations

import os
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from common import begin, db201, interleave, quantiles, report, table
from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion

from shmio.config import Address, Mqtt, MqttTopic
from shmio.endpoints.mqtt.bridge import Bridge
from shmio.endpoints.mqtt.feed import MAX_FRAMES_PER_TURN
from shmio.layout.model import Layout, Register
from shmio.segment import BlockSpec, BlockWriter, ProcessSpec, Segment
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port

PERIOD_S = 0.02
MOST_IN_FLIGHT = 1000
OURS = "shmio's bridge"
STAMPED = Layout("STAMPED", None, 8, False, (Register("Stamp", "LINT", (), 0, None, 8, 1),))


@contextmanager
def segment(layout: Layout) -> Iterator[Segment]:
    block = BlockSpec("cell", layout, round(PERIOD_S * 1e9), 60_000_000_000, 1 << 24)
    with Segment.create(
        f"bench-{os.getpid()}", [block], [ProcessSpec("cell", "source"), ProcessSpec("mqtt", "mqtt")]
    ) as made:
        try:
            yield made
        finally:
            made.unlink()


@contextmanager
def bridge(made: Segment, address: Address, qos: int) -> Iterator[Bridge]:
    rules = [MqttTopic(match="**", qos=qos)]
    running = Bridge(
        made, made.processes.find("mqtt"), Mqtt(broker="external", host=str(address), prefix="bench", topic=rules)
    )
    try:
        while not running.connection.up or running.outbox.busy or running.connection.in_flight:
            running.run_once()
        yield running
    finally:
        running.close()


class Moving:
    """Frames of DB201 in which 20 REALs move, as in the A50 cell."""

    def __init__(self, made: Segment) -> None:
        layout = made.blocks["cell"].layout
        self.registers = [register for register in layout.registers if register.type == "REAL"][:20]
        self.frames = 0
        self._writer: BlockWriter = made.writer("cell")
        self._image = bytearray(layout.size)
        self.publish()

    def publish(self) -> None:
        self.frames += 1
        for place, register in enumerate(self.registers):
            struct.pack_into(">f", self._image, register.offset, 0.001 * self.frames + place)
        self._writer.publish(self._image, cycle=self.frames)


def ours(running: Bridge, moving: Moving, duration_s: float) -> Callable[[], float]:
    """Make a sampler of the bridge's messages a second, with frames published as fast as the bridge takes them."""

    def sample() -> float:
        before, begun_s = running.outbox.sent, time.perf_counter()
        while time.perf_counter() - begun_s < duration_s:
            for _ in range(MAX_FRAMES_PER_TURN):  # as a bridge that is behind finds them: it has to wait for none
                moving.publish()
            running.run_once()
            while running.outbox.busy:
                running.run_once()
        while running.connection.in_flight:
            running.run_once()
        return (running.outbox.sent - before) / (time.perf_counter() - begun_s)

    return sample


def bare(address: Address, moving: Moving, qos: int, duration_s: float) -> Callable[[], float]:
    """Make a sampler of the messages a second that paho alone sends, with its loop in the same thread."""
    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
    client.max_inflight_messages_set(0)
    open_mids: set[int] = set()
    if qos:  # with QoS 0 paho calls it, too, and makes objects for it: it would take half of the time
        client.on_publish = lambda _client, _data, mid, *_: open_mids.discard(mid)
    client.connect(address.host, address.port)
    while not client.is_connected():
        client.loop(0.1)
    topics = [f"bare/cell/{register.path}/out" for register in moving.registers]

    def sample() -> float:
        count, begun_s = 0, time.perf_counter()
        while time.perf_counter() - begun_s < duration_s:
            for place, topic in enumerate(topics):
                info = client.publish(topic, f"{0.001 * count + place:.6f}", qos, retain=True)
                if qos:
                    open_mids.add(info.mid)
                count += 1
            client.loop_read(100)
            while len(open_mids) > MOST_IN_FLIGHT or client.want_write():
                client.loop(0.1)
        while open_mids:
            client.loop(0.1)
        return count / (time.perf_counter() - begun_s)

    return sample


def latencies(address: Address, qos: int, count: int) -> list[float]:
    """Return the times in ms from the publication of a frame to the arrival of its value at a subscriber."""
    with segment(STAMPED) as made, bridge(made, address, qos) as running:
        subscriber = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("mqtt_subscriber.py")), str(address), str(count)],
            stdout=subprocess.PIPE,
            text=True,
        )
        with subscriber:
            assert subscriber.stdout is not None
            assert subscriber.stdout.readline() == "ready\n"
            writer, stop = made.writer("cell"), threading.Event()

            def publish() -> None:
                cycle = 0
                while not stop.wait(PERIOD_S):
                    cycle += 1
                    writer.publish(struct.pack(">q", time.monotonic_ns()), cycle=cycle)

            publishing = threading.Thread(target=publish)
            publishing.start()
            while subscriber.poll() is None:
                running.run_once()
            stop.set()
            publishing.join()
            return [float(line) for line in subscriber.stdout]


def share(address: Address, qos: int, duration_s: float) -> float:
    """Return the percentage of a core that the bridge's thread uses at 50 Hz."""
    with segment(db201()) as made:
        moving, stop = Moving(made), threading.Event()

        def publish() -> None:
            while not stop.wait(PERIOD_S):
                moving.publish()

        with bridge(made, address, qos) as running:
            publishing = threading.Thread(target=publish)
            publishing.start()
            begun_s, used_s = time.perf_counter(), time.thread_time()
            while time.perf_counter() - begun_s < duration_s:
                running.run_once()
            percent = 100 * (time.thread_time() - used_s) / (time.perf_counter() - begun_s)
            stop.set()
            publishing.join()
    return percent


def main() -> None:
    quick = begin("MQTT: messages a second beside a bare publisher, latency, CPU")
    if reason := missing():
        raise SystemExit(reason)
    with tempfile.TemporaryDirectory() as folder, reserved_port() as address:
        broker = Mosquitto(Path(folder), address, "allow_anonymous true", "max_inflight_messages 1000")
        broker.start()
        try:
            for qos in (0, 1):
                with segment(db201()) as made:
                    moving = Moving(made)
                    with bridge(made, address, qos) as running:
                        duration_s = 0.2 if quick else 2.0
                        samples = interleave(
                            {
                                OURS: ours(running, moving, duration_s),
                                "paho, bare": bare(address, moving, qos, duration_s),
                            },
                            2 if quick else 9,
                        )
                report(f"QoS {qos}", "messages/s", samples, OURS, "more", "paho, bare")
            rows = []
            for qos in (0, 1):
                found = latencies(address, qos, 50 if quick else 1500)
                percent = statistics.median(share(address, qos, 0.5 if quick else 5.0) for _ in range(3))
                rows.append([f"QoS {qos}", *(f"{cut:.2f}" for cut in quantiles(found)), f"{percent:.1f}"])
            table(["50 Hz: frame to subscriber, ms", "median", "p90", "p99", "% of a core, DB201"], rows)
        finally:
            broker.stop()


if __name__ == "__main__":
    main()
