"""A cell is recorded, and then replayed in its place. Clients see the same data with another provenance."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import grpc
import pytest

import shmio
from shmio.client import connect
from shmio.config import Address
from shmio.errors import RemoteError
from shmio.testing.cell import PATIENCE_S, Cell, kill, until
from shmio.testing.mosquitto import missing
from shmio.testing.ports import reserved_port
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub as V1Stub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as V2Stub
from tests.system.armed import ARMED
from tests.unit.endpoints.mqtt.harness import PREFIX, listening

# A busy host's delays are not in the recording: no value may turn stale, neither live nor in the replay.
RECORDED = (
    ARMED.replace('connector = "s7"\n', 'connector = "s7"\nstale_ms = 10_000\n') + '\n[recorder]\ndirectory = "dumps"\n'
)
MQTT = """
[mqtt]
listen = "{broker}"
prefix = "shmio/test"
[[mqtt.topic]]
match = "cell/Robot_800/Axs1_Pos"
payload = "json"
qos = 0
[[mqtt.topic]]
match = "*"
publish = false
"""
"""One topic, with QoS 0: no number of unacknowledged messages makes the bridge skip values while a busy host holds up
the broker."""
FRAMES = int(os.environ.get("SHMIO_REPLAY_FRAMES", "150"))
"""Number of frames that are recorded and replayed, at 50 a second."""
POSITION = "cell/Robot_800/Axs1_Pos"
PLACE = "cell/Outputs/100"


class Streams:
    """Reads what clients of all interfaces receive, until the instance ends or the test fails."""

    def __init__(self, cell: Cell, broker: Address, test: ExitStack) -> None:
        self._stack = test.enter_context(ExitStack())
        self._threads: list[threading.Thread] = []
        self._stack.callback(self._join)  # after all else is closed, which ends the streams
        self._listener = self._stack.enter_context(listening(broker, f"{PREFIX}/{POSITION}/out", f"{PREFIX}/status"))
        self.mqtt: list[tuple[Any, ...]] = []
        self.v1: list[bytes] = []
        self.v2: list[bytes] = []
        self.native: list[tuple[Any, ...]] = []
        channel = self._stack.enter_context(grpc.insecure_channel(str(cell.grpc)))
        first = V1Stub(channel).Subscribe(v1.TopicDescriptor(path=POSITION), wait_for_ready=True)  # type: ignore[no-untyped-call]
        stub = V2Stub(channel)  # type: ignore[no-untyped-call]
        second = stub.CreateSubscriber(v2.Subscriber(name="test", uuid="test"))
        second.initial_metadata()
        stub.Subscribe(v2.SubscriptionRequest(path=POSITION, subscriberUUID="test"), timeout=PATIENCE_S)
        client = self._stack.enter_context(connect(str(cell.grpc)))
        self._client = client
        wholes = client.subscribe(POSITION, PLACE, every_frame=True)
        self._threads = [
            threading.Thread(target=_read, args=(first, lambda message: self.v1.append(message.SerializeToString()))),
            threading.Thread(target=_read, args=(second, lambda message: self.v2.append(message.SerializeToString()))),
            threading.Thread(target=_read, args=(wholes, lambda update: self.native.append(_shown(update)))),
        ]
        for thread in self._threads:
            thread.start()

    def await_frames(self, count: int) -> None:
        """Wait until shmio.v1 has delivered this many frames."""
        until(lambda: len(self.native) >= count, f"{count} frames")

    def close(self) -> None:
        """Wait for the readers. Call it after the instance has ended, which ends the streams."""
        self._join()
        while (message := self._listener.message()).payload != b"offline":
            if message.topic.endswith("/out"):
                told = json.loads(message.payload)
                self.mqtt.append((told["value"], told["quality"], told["reason"], told["source_time"]))
        self._stack.close()

    def _join(self) -> None:
        for thread in self._threads:
            thread.join(PATIENCE_S)
            assert not thread.is_alive()


def _read(stream: Any, take: Callable[[Any], object]) -> None:
    try:
        for message in stream:
            take(message)
    except (grpc.RpcError, RemoteError):
        return


def _shown(update: Any) -> tuple[Any, ...]:
    values = tuple(update[path] for path in (POSITION, PLACE))
    return update.cycle, update.clock_ns, update.source_ns, str(update.quality), update.reason, *values


def good(cell: Cell) -> bool:
    return bool(cell.processes()["cell"]["quality"] == "good")


def dump(cell: Cell, *known: Path) -> Path:
    [file] = set((cell.folder / "dumps").glob("*.mem")) - set(known)
    return file


def written(cell: Cell, value: int) -> None:
    done = cell.run("shmio", "set", PLACE, str(value))
    assert done.returncode == 0, done.stderr


@contextmanager
def replaying(cell: Cell, file: Path, *options: str) -> Iterator[shmio.Attachment]:
    up = cell.supervisor("up", "--detach", "--mode", "replay", "--from", str(file), *options)
    assert up.returncode == 0, up.stderr
    with shmio.attach(cell.instance, writable=True) as attached:
        yield attached
    cell.down()


def over(attached: shmio.Attachment) -> bool:
    return all(one.over for one in attached.replay.status())


@pytest.fixture
def broker() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """Closes what a test that fails has left open."""
    with ExitStack() as stack:
        yield stack


@pytest.mark.skipif(bool(missing()), reason=missing())
@pytest.mark.timeout(240 + FRAMES // 10)
def test_a_replay_gives_the_same_recording_and_the_same_streams(
    make_cell: Callable[..., Cell], broker: Address, stack: ExitStack
) -> None:
    cell = make_cell(config=RECORDED + MQTT.replace("{broker}", str(broker)))
    cell.up()
    until(lambda: good(cell), "good quality")
    live = Streams(cell, broker, stack)
    written(cell, 5)
    with shmio.attach(cell.instance, writable=True) as attached:
        with attached.inject("cell/Robot_800/Axs2_Pos") as shadow:
            shadow.set({"cell/Robot_800/Axs2_Pos": 77.5})
            until(lambda: len(live.native) > 100, "frames")
        written(cell, 6)
        with attached.inject(f"{PLACE}/in"):
            done = cell.run("shmio", "set", PLACE, "9")
            assert done.stdout == f"{PLACE}  taken\n"
    while len(live.native) < FRAMES:
        live.await_frames(min(FRAMES, len(live.native) + 500))
        written(cell, len(live.native) % 100)
    cell.down()
    live.close()
    first = dump(cell)
    with replaying(cell, first, "--paused", "--record") as attached:
        assert cell.status()["mode"] == "replay"
        assert sorted(cell.processes()) == ["broker", "cell", "grpc", "mqtt", "recorder"]
        replayed = Streams(cell, broker, stack)
        until(lambda: bool(replayed.v1 and replayed.v2 and replayed.native), "the first messages")
        refused = cell.run("shmio", "set", PLACE, "1")
        assert "refused" in refused.stdout + refused.stderr
        [playing] = attached.replay.play()
        until(lambda: over(attached), "the end", PATIENCE_S + playing.length_s)
    replayed.close()
    second = dump(cell, first)
    found = cell.run("shmio-dump", "diff", "--json", str(first), str(second))
    [told] = json.loads(found.stdout)["sources"]
    events = told["events"]
    assert (events["differing"], events["only_first"], events["only_second"]) == (0, 0, 2), (
        "the writes that the replay refused"
    )
    assert found.returncode == 1
    assert (told["frames"]["differing"], told["frames"]["only_first"], told["frames"]["only_second"]) == (0, 0, 0)
    assert told["frames"]["compared"] >= FRAMES
    assert told["timing_ms"]["max"] == 0, "each frame has its recorded time, to the ns"
    same_events(cell, first, second)
    for name in ("v1", "v2", "native", "mqtt"):
        assert_continues(name, getattr(live, name), getattr(replayed, name))


def same_events(cell: Cell, first: Path, second: Path) -> None:
    """Assert that the replay has all recorded events in order, and in addition the writes that it refused."""
    with shmio.open_dump(first) as one, shmio.open_dump(second) as other:
        told, again = (
            [
                (event.kind, event.text, event.quality, event.offset, event.data, event.clock_ns, event.command)
                for event in (entry.item for entry in dump.events("cell"))
                if event.kind > 2 and not event.text.startswith("replay: ")
            ]
            for dump in (one, other)
        )
        ours = [event for event in again if event[0] in (4, 7) and event not in told]
    assert len(ours) == 2
    assert [event for event in again if event not in ours] == told


def assert_continues(name: str, live: list[Any], replayed: list[Any]) -> None:
    """Assert that the replay's client received all that the live client did.

    The first message is not compared. The replay's client may have received more, as it was
    connected for longer.
    """
    assert len(live) > 10, name
    at = replayed.index(live[1])
    assert replayed[at : at + len(live) - 1] == live[1:], name


def test_a_replay_with_a_model_and_killed_processes(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=RECORDED)
    cell.up()
    until(lambda: cell.processes()["recorder"]["counters"]["frames"] >= 100, "frames")
    cell.down()
    file = dump(cell)
    recorded = (
        (cell.folder / "supervisor.toml").read_text().partition("[[source]]")[0]
        + f"""
[[source]]
name = "cell"
connector = "replay"
file = "{file.relative_to(cell.folder)}"
loop = true

[[source]]
name = "sim"
connector = "simulation"
model = "shmio.simulation.loopback:Loopback"
[source.connections]
"joints/Kuka.j1/R" = "{POSITION}"

[recorder]
directory = "again"
"""
    )
    (cell.folder / "supervisor.toml").write_text(recorded)
    checked = cell.supervisor("check")
    assert checked.returncode == 0, checked.stderr
    assert "source cell: DB201, 22 registers" in checked.stdout
    cell.up()
    with shmio.attach(cell.instance, writable=True) as attached:
        until(
            lambda: all(one["quality"] == "good" for one in cell.processes().values() if one["kind"] == "source"),
            "good",
        )
        block = attached.block("cell")
        before = block.incarnation
        kill(cell.processes()["cell"]["pid"])
        until(lambda: block.incarnation > before, "another process")
        until(lambda: attached.read(POSITION).quality.name == "GOOD", "good again")
        with attached.inject(POSITION) as shadow:
            shadow.set({POSITION: 123.0})
            assert attached[POSITION] == 123.0
            until(lambda: attached["sim/joints/Kuka.j1/R"] == 123.0, "the value in the model")
        attached.step(0.5)
        assert attached.clock.virtual
        frame = attached.frame("cell").frame.number
        attached.step(0.1)
        assert attached.frame("cell").frame.number - frame in (4, 5, 6)
    cell.down()
    [again] = (cell.folder / "again").iterdir()
    with shmio.open_dump(again) as found:
        cycles = [entry.item.cycle for entry in found.frames("cell")]
    with shmio.open_dump(file) as found:
        known = [entry.item.cycle for entry in found.frames("cell")]
    lost = [(one, two) for one, two in pairwise(cycles) if two - one not in (0, 1) and two > one]
    if "this process was delayed" not in cell.logs():  # the host took 10 s to start the process
        assert all(two == known[known.index(one) + 1] for one, two in lost), "the kill has lost no frame"


@pytest.mark.parametrize(
    ("spoil", "error"),
    [
        (lambda file: file.write_bytes(b""), "replay.file: "),
        (lambda file: file.write_bytes(b"\x89MCAP0\r\n"), "replay.file: "),
        (lambda file: file.unlink(), "replay.file: "),
    ],
)
def test_a_file_that_cannot_be_played_gives_one_clear_line(
    make_cell: Callable[..., Cell], spoil: Callable[[Path], object], error: str
) -> None:
    cell = make_cell(config=RECORDED)
    file = cell.folder / "some.mem"
    file.touch()
    spoil(file)
    up = cell.supervisor("up", "--detach", "--mode", "replay", "--from", str(file))
    assert (up.returncode, up.stderr.count("\n")) == (1, 1)
    assert up.stderr.startswith(f"supervisor.toml: {error}{file}"), up.stderr
