"""The common conformance suites, run with the ros2 connector and a node made with cyclonedds.

DDS has no connection that a proxy could break. In place of connection faults, the node leaves, dies, or is frozen.
"""

from __future__ import annotations

import random
import socket
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from typing import Any, ClassVar

import pytest

from shmio.connectors.base import Connector, Lost, WriteLostError
from shmio.connectors.ros.dds import Ros2Connector, Ros2Options
from shmio.errors import ConnectorError
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.model.statuses import BAD_TIMEOUT, GOOD, StatusArea
from shmio.segment import Frame, Write
from shmio.testing.conformance import Rig, Run, connect
from shmio.testing.table_conformance import TableConformance, Tags, connected, value_of
from shmio.testing.write_conformance import SPARE, WriteConformance, Writer, WriteRig, write
from tests.unit.connectors.ros.dds_peer import Peer
from tests.unit.connectors.ros.std_topics import STD_TOPICS

COUNTS = 20


class NodeFaults:
    """The suite's interface for connection faults, which it carries out on the node."""

    def __init__(self, peer: Peer) -> None:
        self._peer = peer
        self._away = False

    def refuse(self) -> None:
        self._peer.ask("leave")
        self._away = True

    def admit(self) -> None:
        if self._away:
            self._away = False
            self._peer.ask("join")
            self.begin()

    def begin(self) -> None:
        self._peer.ask("count", COUNTS, 0.004)
        self._peer.ask("spare", [0] * SPARE)

    def freeze(self) -> None:
        self._peer.freeze()

    def thaw(self) -> None:
        self._peer.thaw()

    def cut(self, *, reset: bool) -> None:
        self.refuse()

    def pass_all(self) -> None:
        self.thaw()
        self.admit()


class Ros2Rig:
    """The node that the suites read and write."""

    proxy: Any

    def __init__(self, peer: Peer, *, changed: bool = False) -> None:
        self.peer = peer
        self.proxy = NodeFaults(peer)
        self.timeout_ms = 500
        counted = peer.address("counted", "std_msgs/Float64MultiArray data")
        tags: dict[str, object] = {}
        if changed:
            tags["added"] = {"type": "STRING[20]", "address": peer.address("mode", "std_msgs/String data")}
        tags["counted"] = {"type": f"ARRAY[1..{COUNTS}] OF LREAL", "address": counted}
        self._at = len(tags) - 1
        for at in range(0 if changed else SPARE):
            address = peer.address("spare", f"std_msgs/Int16MultiArray data[{at}]")
            tags[f"spare/{at}"] = {"type": "BYTE", "address": address, "writable": True}
        if not changed:
            tags["fixed"] = {"type": "INT", "address": "/nobody std_msgs/Int16 data", "writable": True}
        self.layout: Layout = place_tags("device", tags).with_statuses()
        self.area = StatusArea(self.layout)
        by_path = {register.path: register for register in self.layout.registers}
        self._counted = codec(by_path["counted"], "little")
        if changed:
            return
        self.spare = self.flags = by_path["spare/0"].offset
        self.refused = Write(by_path["fixed"].offset, 0, b"\1\0")

    def changed(self) -> Ros2Rig:
        return Ros2Rig(self.peer, changed=True)

    def connector(self) -> Connector:
        return Ros2Connector(Ros2Options(domain=self.peer.domain, timeout=self.timeout_ms, max_age=100), self.layout)

    def generation(self, raw: bytes) -> int:
        counted = self._counted.decode(raw)
        assert isinstance(counted, list)
        numbers = {one for one in counted if isinstance(one, float)}
        assert len(numbers) == 1, "an array with elements of different moments"
        return int(numbers.pop())

    def counted(self, frame: Frame) -> bool:
        """Return whether the counted register of a frame is good."""
        return self.area.get(frame.raw, self._at).code == 0


MANY, EACH = 40, 5


class Ros2Table:
    """Topics with all types of ``std_msgs``, to which the node subscribes."""

    unknown: ClassVar[Mapping[str, object]] = {"type": "INT", "address": "/nowhere std_msgs/Int16 data"}

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self.types: Tags = {
            topic: {"type": kind, "address": peer.address(topic, f"std_msgs/msg/{name} data"), "writable": True}
            for topic, (kind, name) in STD_TOPICS.items()
        }
        self.many: Tags = {
            f"v{at}_{place}": {
                "type": "INT", "address": peer.address(f"many{at}", f"std_msgs/Int16MultiArray data[{place}]"),
                "writable": True,
            }
            for at in range(MANY)
            for place in range(EACH)
        }  # fmt: skip

    def connector(self, layout: Layout) -> Connector:
        return Ros2Connector(Ros2Options(domain=self.peer.domain, timeout=5000), layout)


@pytest.fixture(scope="module")
def wide() -> Iterator[Ros2Table]:
    """A node with many topics, whose discovery would delay the other tests."""
    with Peer() as peer:
        kinds = {topic: name for topic, (_, name) in STD_TOPICS.items()}
        peer.ask("open", kinds | {f"many{at}": "Int16MultiArray" for at in range(MANY)})
        yield Ros2Table(peer)


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    with Peer() as peer:
        yield peer


class TestRos2(TableConformance, WriteConformance):
    @pytest.fixture
    def table(self, wide: Ros2Table) -> Ros2Table:
        return wide

    def test_the_node_has_the_values_and_sends_others(self, wide: Ros2Table) -> None:
        """A node with types of its own receives what is written, and its values arrive."""
        with connected(wide, wide.types) as source:
            written = {path: value_of(tag, 0) for path, tag in wide.types.items()}
            assert not any(source.write(written))
            assert {path: wide.peer.ask("received_data", path) for path in written} == written
            sent = {path: value_of(tag, 1) for path, tag in wide.types.items()}
            for path, value in sent.items():
                wide.peer.ask("send_data", path, value)
            source.until(sent, dict.fromkeys(sent, GOOD))

    @pytest.fixture
    def rig(self, request: pytest.FixtureRequest, peer: Peer) -> Iterator[Ros2Rig]:
        own = Peer() if request.node.name == "test_reset" else None  # which ends the node's process
        with own or nullcontext():
            rig = Ros2Rig(own or peer)
            rig.proxy.begin()
            try:
                yield rig
            finally:
                rig.peer.thaw()
                rig.proxy.admit()

    @pytest.fixture
    def writer(self, run: Run, rig: Ros2Rig) -> Writer:
        """Provide a writer, once the node is discovered in both directions."""
        run.good()
        writer = Writer(run)
        for _ in range(1000):
            rig.peer.ask("spare", [0] * SPARE)
            if not writer.once_open(Write(rig.spare, 0, bytes(SPARE))).text:
                break
        return writer

    def test_a_slow_device(self, run: Run, rig: Ros2Rig) -> None:  # type: ignore[override]
        """A node that publishes more rarely than the source polls, but often enough, is good."""
        last = rig.generation(run.until(rig.counted).raw)
        rig.peer.ask("count", COUNTS, 0.05)
        for _ in range(3):
            frame = run.newer(last)
            assert rig.counted(frame)
            last = rig.generation(frame.raw)

    def test_absent_at_start(self, absent: None, run: Run, rig: Rig) -> None:
        """The source is bad with a reason until there is a node, and then good."""
        assert "no publisher or subscriber of this source's topics" in run.bad().reason
        rig.proxy.admit()
        run.good()

    def test_reset(self, run: Run, rig: Ros2Rig) -> None:  # type: ignore[override]
        """A node dies and another node takes its place: the values of the new node arrive."""
        run.until(rig.counted)
        rig.peer.kill()
        run.until(lambda frame: not rig.counted(frame))
        rig.peer.start()
        rig.peer.ask("restore", 1_000_000)  # as the counting goes on
        rig.proxy.begin()
        run.until(rig.counted)

    test_cut_in_the_middle_of_an_answer: Any = None  # DDS delivers whole messages

    def test_half_open(self, run: Run, rig: Ros2Rig) -> None:  # type: ignore[override]
        """The node is silent: its registers are bad after the age limit, then good."""
        run.until(rig.counted)
        rig.proxy.freeze()
        frame = run.until(lambda frame: not rig.counted(frame))
        assert rig.area.get(frame.raw, 0).code == BAD_TIMEOUT
        rig.proxy.thaw()
        run.until(rig.counted)

    def test_a_reload_that_adds_and_removes_registers_without_reconnecting(  # type: ignore[override]
        self, others: Iterator[Ros2Rig], run: Run, rig: Ros2Rig
    ) -> None:
        """Such reloads keep the participant: the node discovers no other one."""
        last = rig.generation(run.until(rig.counted).raw)
        present = rig.peer.ask("participants")
        for _ in range(4):
            run.reload(other := next(others))
            frame = run.good()
            assert len(run.frames) == 1, "the participant has left"
            assert other.counted(frame)
            assert other.generation(frame.raw) >= last
            last = other.generation(run.newer(last).raw)
        assert run.loop.counters.connects == 1
        assert rig.peer.ask("participants") == present

    @pytest.mark.parametrize("garbage", [b"\0" * 64, b"\xff" * 64, b"RTPS\2\1\1\x10" + random.Random(1).randbytes(200)])
    def test_garbage(self, run: Run, rig: Ros2Rig, garbage: bytes) -> None:  # type: ignore[override]
        """Datagrams that are not of DDS never become a value, and disturb nothing."""
        run.until(rig.counted)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for port in range(7400 + 250 * rig.peer.domain, 7400 + 250 * rig.peer.domain + 24):
                sender.sendto(garbage, ("127.0.0.1", port))
        last = rig.generation(run.until(rig.counted).raw)
        run.until(lambda frame: rig.counted(frame) and rig.generation(frame.raw) > last)

    def test_a_late_answer_is_not_taken_for_the_next(self, run: Run, rig: Ros2Rig) -> None:  # type: ignore[override]
        """A frozen node publishes late. Values must not go back, which the fixture ``run`` checks at its end."""
        run.until(rig.counted)
        for _ in range(2):
            rig.proxy.freeze()
            run.until(lambda frame: not rig.counted(frame))
            rig.proxy.thaw()
            run.until(rig.counted)

    def test_several_writes_in_one_command(self, run: Run, writer: Writer, rig: Ros2Rig) -> None:  # type: ignore[override]
        """A command for several fields of a message is one message, which the node receives."""
        frame = writer.written(Write(rig.spare, 0, b"ab"), Write(rig.spare + 4, 0, b"\x42"))
        assert frame.raw[rig.spare : rig.spare + SPARE] == b"ab\0\0\x42\0\0\0"
        assert rig.peer.ask("commanded") == list(b"ab\0\0\x42\0\0\0")

    def test_a_bit_is_written_without_its_neighbours(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """A message cannot carry a single bit of a number: the write is refused, and changes nothing."""
        writer.written(Write(rig.spare, 0, b"\x0f"))
        end = writer.write(Write(rig.spare, 1, b"\0"))
        assert "write the whole register" in end.text
        assert run.good().raw[rig.spare] == 0x0F

    def test_a_refused_item_among_good_ones(self, rig: Ros2Rig) -> None:  # type: ignore[override]
        """A topic without a subscriber is refused; the others are published."""
        connector = rig.connector()
        try:
            connect(connector)
            for _ in range(1000):
                rig.peer.ask("spare", [0] * SPARE)
                connector.read()
                if not write(connector, [Write(rig.spare, 0, bytes(SPARE))])[0]:
                    break
            writes = [Write(rig.spare, 0, b"one"), rig.refused, Write(rig.spare + 4, 0, b"two")]
            outcomes = write(connector, writes)
            assert [bool(outcome) for outcome in outcomes] == [False, True, False]
            assert "no node subscribes" in outcomes[1]
            assert connector.read()[rig.spare : rig.spare + SPARE] == b"one\0two\0"
        finally:
            connector.close()

    def test_a_late_confirmation_is_not_taken_for_the_next(self, run: Run, writer: Writer, rig: Ros2Rig) -> None:  # type: ignore[override]
        """A frozen node acknowledges nothing, so the outcome is unknown. The next write gets its own outcome."""
        rig.proxy.freeze()
        end = writer.write(Write(rig.spare, 0, b"late"))
        assert "did not acknowledge" in end.text
        rig.proxy.thaw()
        run.until(rig.counted)

    @pytest.mark.parametrize("count", [1])
    def test_lost_in_mid_write(self, run: Run, writer: Writer, rig: Ros2Rig, count: int) -> None:  # type: ignore[override]
        """A node leaves and returns: the next write that succeeds reaches it."""
        rig.proxy.refuse()
        run.bad()
        rig.proxy.admit()
        run.until(rig.counted)
        value = b"at last!"
        while writer.once_open(Write(rig.spare, 0, value)).text:  # until the node is discovered again
            rig.peer.ask("spare", [0] * SPARE)
        assert rig.peer.ask("commanded") == list(value)

    @pytest.mark.parametrize("fault", ["no answer"])
    def test_of_each_lost_write_what_is_said_is_true(self, rig: Ros2Rig, fault: str) -> None:  # type: ignore[override]
        """The node is frozen during several writes, which are one message."""
        connector = rig.connector()
        try:
            connect(connector)
            for _ in range(1000):
                rig.peer.ask("spare", [0] * SPARE)
                connector.read()
                if not write(connector, [Write(rig.spare, 0, bytes(SPARE))])[0]:
                    break
            rig.proxy.freeze()
            with pytest.raises(ConnectorError) as raised:
                write(connector, [Write(rig.spare + place, 0, bytes([place + 1])) for place in range(SPARE)])
            assert isinstance(raised.value, WriteLostError)
            assert set(raised.value.outcomes) == {Lost.UNKNOWN}
        finally:
            connector.close()
