"""The common conformance suites, run with the rosbridge connector against a server made with Node's ws."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Iterator, Mapping
from typing import ClassVar

import pytest

from shmio.connectors.base import Connector
from shmio.connectors.ros.rosbridge import RosbridgeConnector, RosbridgeOptions
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.model.statuses import GOOD
from shmio.segment import EventKind, Write
from shmio.testing.conformance import TIMEOUT_MS, Rig, Run
from shmio.testing.proxy import FaultProxy
from shmio.testing.table_conformance import TableConformance, Tags, connected, value_of
from shmio.testing.write_conformance import SPARE, WriteConformance, Writer, WriteRig
from tests.unit.connectors.ros.bridge import Bridge, framing
from tests.unit.connectors.ros.std_topics import STD_TOPICS

COUNTS = 20
ARRAY = {"layout": {"dim": [], "data_offset": 0}}


def layout(*, changed: bool = False) -> Layout:
    tags: dict[str, object] = {"added": {"type": "INT", "address": "/added std_msgs/Int16 data"}} if changed else {}
    tags["counted"] = {
        "type": f"ARRAY[1..{COUNTS}] OF LREAL", "address": "/counted std_msgs/Float64MultiArray data"
    }  # fmt: skip
    if changed:
        return place_tags("device", tags).with_statuses()
    tags |= {
        f"spare/{at}": {"type": "BYTE", "address": f"/spare std_msgs/Int16MultiArray data[{at}]", "writable": True}
        for at in range(SPARE)
    }
    tags["fixed"] = {"type": "INT", "address": "/fixed std_msgs/msg/Int16 data", "writable": True}
    return place_tags("device", tags).with_statuses()


class RosbridgeRig:
    """The server behind a proxy."""

    def __init__(self, proxy: FaultProxy, *, changed: bool = False) -> None:
        self.proxy = proxy
        self.timeout_ms = TIMEOUT_MS
        self.layout = layout(changed=changed)
        by_path = {register.path: register for register in self.layout.registers}
        self._counted = codec(by_path["counted"], "little")
        if changed:
            return
        self.spare = self.flags = by_path["spare/0"].offset
        self.refused = Write(by_path["fixed"].offset, 0, b"\1\0")

    def changed(self) -> RosbridgeRig:
        return RosbridgeRig(self.proxy, changed=True)

    def connector(self) -> Connector:
        return RosbridgeConnector(
            RosbridgeOptions(url=f"ws://{self.proxy.address}", timeout=self.timeout_ms), self.layout
        )

    def generation(self, raw: bytes) -> int:
        counted = self._counted.decode(raw)
        assert isinstance(counted, list)
        numbers = {one for one in counted if isinstance(one, float)}
        assert len(numbers) == 1, "an array with elements of different moments"
        return int(numbers.pop())


MANY = 200


class RosbridgeTable:
    """Topics with all types of ``std_msgs``."""

    unknown: ClassVar[Mapping[str, object]] = {"type": "INT", "address": "/nowhere std_msgs/Int16 data"}
    types: ClassVar[Tags] = {
        topic: {"type": kind, "address": f"/{topic} std_msgs/{name} data", "writable": True}
        for topic, (kind, name) in STD_TOPICS.items()
    }
    many: ClassVar[Tags] = {
        f"v{at}": {"type": "INT", "address": f"/many{at} std_msgs/Int16 data", "writable": True} for at in range(MANY)
    }

    def __init__(self, bridge: Bridge) -> None:
        self.bridge = bridge

    def connector(self, layout: Layout) -> Connector:
        return RosbridgeConnector(RosbridgeOptions(url=self.bridge.url), layout)


@pytest.fixture(scope="module")
def bridge() -> Iterator[Bridge]:
    with Bridge() as bridge:
        bridge.ask("publish", "/fixed", {"data": 7})
        bridge.ask("publish", "/added", {"data": 9})
        bridge.ask("refuse", "/fixed", "it is fixed")
        bridge.ask("count", "/counted", COUNTS, 4)
        yield bridge


class TestRosbridge(TableConformance, WriteConformance):
    @pytest.fixture
    def table(self, bridge: Bridge) -> RosbridgeTable:
        return RosbridgeTable(bridge)

    def test_the_server_has_the_values_and_sends_others(self, table: RosbridgeTable) -> None:
        """The server receives what is written, and the values that others publish arrive."""
        with connected(table, table.types) as source:
            written = {path: value_of(tag, 0) for path, tag in table.types.items()}
            assert not any(source.write(written))
            for path, value in written.items():
                data = table.bridge.ask("last", f"/{path}")["data"]
                assert (list(b64decode(data)) if isinstance(data, str) and isinstance(value, list) else data) == value
            sent = {path: value_of(tag, 1) for path, tag in table.types.items()}
            for path, value in sent.items():
                table.bridge.ask("publish", f"/{path}", {"data": value})
            source.until(sent, dict.fromkeys(sent, GOOD))

    @pytest.fixture
    def rig(self, bridge: Bridge) -> Iterator[RosbridgeRig]:
        bridge.ask("publish", "/spare", ARRAY | {"data": [0] * SPARE})
        with FaultProxy(bridge.address, framing=framing) as proxy:
            yield RosbridgeRig(proxy)

    def test_a_late_answer_is_not_taken_for_the_next(self, run: Run, rig: Rig) -> None:
        """There are no requests. A late message on an old connection must not be seen on the next connection."""
        run.good()
        rig.proxy.hold()
        run.bad()
        rig.proxy.release()
        run.good()

    def test_several_writes_in_one_command(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """A command for several fields of a message is one message."""
        frame = writer.written(Write(rig.spare, 0, b"ab"), Write(rig.spare + 4, 0, b"\x42"))
        assert frame.raw[rig.spare : rig.spare + SPARE] == b"ab\0\0\x42\0\0\0"

    def test_a_bit_is_written_without_its_neighbours(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """A message cannot carry a single bit of a number: the write is refused, and changes nothing."""
        writer.written(Write(rig.spare, 0, b"\x0f"))
        end = writer.write(Write(rig.spare, 1, b"\0"))
        assert "write the whole register" in end.text
        assert run.good().raw[rig.spare] == 0x0F

    @pytest.mark.parametrize("count", [1, 30])
    def test_lost_in_mid_write(self, run: Run, writer: Writer, rig: WriteRig, count: int) -> None:
        """The connection breaks around a write: the reported outcome is true.

        A frame may still be good while the end of the connection is on its way. A write after such a frame may be
        lost, too.
        """
        for turn in range(1, 5):
            rig.proxy.cut_after(count * turn)
            value = bytes([turn]) * SPARE
            end = writer.once_open(Write(rig.spare, 0, value))
            assert end.kind in {EventKind.WRITTEN, EventKind.EXPIRED, EventKind.UNKNOWN}
            rig.proxy.pass_all()
            frame = writer.after(end)
            if end.kind != EventKind.UNKNOWN:
                done = frame.raw[rig.spare : rig.spare + SPARE] == value
                assert done == (end.kind == EventKind.WRITTEN), end
        last = Write(rig.spare, 0, b"at last!")
        for _ in range(3):
            end = writer.once_open(last)
            if end.kind == EventKind.WRITTEN:
                break
        assert end.kind == EventKind.WRITTEN, end
        assert writer.after(end).raw[rig.spare : rig.spare + SPARE] == b"at last!"
