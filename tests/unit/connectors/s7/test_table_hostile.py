"""A tag table read from a controller whose answers a proxy changes: counts, lengths, codes, garbage.

Whatever arrives, a read ends in an image or a ConnectorError. A good register has the controller's value, the number
of requests is bounded, and the connector recovers.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import NamedTuple

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.s7.connector import S7Connector, S7Options
from shmio.emulators.areas import Place, TableMemory
from shmio.emulators.emulator import AREAS
from shmio.emulators.s7 import S7Server, ServerOptions
from shmio.errors import ConnectorError
from shmio.layout.s7.address import Area
from shmio.layout.values.codec import Value
from shmio.layout.values.write import encode
from shmio.model.statuses import BAD_WAITING_FOR_INITIAL_DATA, StatusArea, quality_of
from shmio.model.values import Quality
from shmio.testing.cell import until
from shmio.testing.proxy import FaultProxy
from tests.unit.connectors.s7.test_cpu import CPU
from tests.unit.connectors.s7.test_table import table, values

READS = 3
"""Number of reads during which answers are changed."""
SPARE = 40
"""Maximum number of requests of a read that do not halve ranges: for the mode, the CPU, a block, refused registers."""
SIZE = 400
TAGS: dict[str, object] = {
    **{f"int/{at}": {"type": "INT", "address": f"DB1.DBW{at}"} for at in range(0, 60, 6)},
    **{f"far/{at}": {"type": "DINT", "address": f"DB2.DBD{40 * at}"} for at in range(6)},
    "long": {"type": "ARRAY[1..400] OF BYTE", "address": "DB3.DBB0"},
    "bit": {"type": "BOOL", "address": "%M3.4"},
    "input": {"type": "REAL", "address": "%ID8"},
    "timer": {"type": "WORD", "address": "T5"},
    "gone": {"type": "INT", "address": "DB9.DBW0"},
    "set": {"type": "INT", "address": "DB1.DBW100"},
    **{f"cpu/{name}": tag for name, tag in CPU.items() if name != "int"},
}
OWN = [name for name in TAGS if not name.startswith("cpu/") and name != "gone"]
LAYOUT = table(TAGS)

# -- changes of answers ------------------------------------------------------------------------------------------------


class Item(NamedTuple):
    code: int
    transport: int
    length: int
    data: bytes


def items_of(frame: bytes) -> list[Item] | None:
    """Return the items of an answer to a read; None for any other frame."""
    if len(frame) < 25 or frame[7:9] != b"\x32\x03" or frame[19] != 4:
        return None
    found, at = [], 21
    while at + 4 <= len(frame):
        code, transport, length = struct.unpack_from(">BBH", frame, at)
        size = (length >> 3 if transport in (4, 5) else length) if code == 0xFF else 0
        found.append(Item(code, transport, length, frame[at + 4 : at + 4 + size]))
        at += 4 + size + (size & 1)
    return found


def with_items(frame: bytes, items: list[Item], count: int | None = None) -> bytes:
    """Return the answer with other items. Its lengths are correct."""
    parts = [struct.pack(">BBH", *item[:3]) + item.data for item in items]
    data = b"".join(part + bytes(len(part) & 1) for part in parts[:-1]) + (parts[-1] if parts else b"")
    head = frame[7:13] + struct.pack(">HHH", 2, len(data), 0)
    body = b"\x02\xf0\x80" + head + bytes((4, len(items) & 0xFF if count is None else count)) + data
    return struct.pack(">BxH", 3, 4 + len(body)) + body


Change = Callable[[bytes], bytes | None]


def of_items(change: Callable[[list[Item]], list[Item]], count: int | None = None) -> Change:
    """Return a change of the items of answers to reads. It leaves other frames unchanged."""

    def changed(frame: bytes) -> bytes:
        items = items_of(frame)
        return with_items(frame, change(items), count) if items else frame

    return changed


def of_one(at: int, change: Callable[[Item], Item]) -> Change:
    def changed(items: list[Item]) -> list[Item]:
        at_all = at % len(items)
        return [change(item) if place == at_all else item for place, item in enumerate(items)]

    return of_items(changed)


def refused_job(error: int) -> Change:
    """Return a change that refuses the whole job, or the userdata request, by an error in the header."""
    return lambda frame: (
        frame[:2] + b"\0\x13" + frame[4:8] + b"\2" + frame[9:13] + b"\0\0\0\0" + error.to_bytes(2, "big")
    )


def patched(place: int, value: int) -> Change:
    """Return a change of one byte before the data. It spares the reference, which says whose answer it is."""

    def changed(frame: bytes) -> bytes:
        at = place % 21
        if at in (2, 3, 11, 12) or at >= len(frame):
            return frame
        return frame[:at] + bytes((value,)) + frame[at + 1 :]

    return changed


def resized(cut: int, tail: bytes) -> Change:
    """Return a change that replaces the end of a frame, with a correct TPKT length."""

    def changed(frame: bytes) -> bytes:
        body = frame[4 : max(7, len(frame) - cut)] + tail
        return struct.pack(">BxH", 3, 4 + len(body)) + body

    return changed


byte, word, at = st.integers(0, 255), st.integers(0, 0xFFFF), st.integers(0, 19)
codes = st.sampled_from([0, 1, 3, 5, 6, 7, 0x0A]) | byte.filter(lambda code: code != 0xFF)
CHANGES: st.SearchStrategy[Change] = st.one_of(
    st.builds(lambda: lambda frame: frame),
    st.builds(lambda at, code: of_one(at, lambda item: Item(code, 0, 0, b"")), at, codes),
    st.builds(lambda code: of_items(lambda items: [Item(code, 0, 0, b"") for _ in items]), codes),
    st.builds(lambda at, code: of_one(at, lambda item: item._replace(code=code)), at, codes),
    st.builds(lambda at, length: of_one(at, lambda item: item._replace(length=length)), at, word),
    st.builds(lambda at, kind: of_one(at, lambda item: item._replace(transport=kind)), at, byte),
    st.builds(  # an even number of bytes: an odd one would be padded to other data of the same length
        lambda at, cut: of_one(at, lambda item: item._replace(data=item.data[: 2 * cut])), at, st.integers(0, 5)
    ),
    st.builds(lambda count: of_items(lambda items: items, count), byte),
    st.builds(lambda: of_items(lambda items: items[:-1])),
    st.builds(lambda times: of_items(lambda items: items[:1] * times), st.integers(2, 60)),
    st.builds(refused_job, st.sampled_from([0x8104, 0x8304, 0x8500, 0xD241]) | word.filter(bool)),
    st.builds(patched, st.integers(0, 20), byte),
    st.builds(resized, st.integers(1, 30), st.just(b"")),  # not both: other data of the same length are no fault
    st.builds(resized, st.just(0), st.binary(min_size=1, max_size=12)),
    st.builds(lambda frame: lambda _: frame, st.binary(min_size=1, max_size=60)),
    st.builds(lambda: lambda frame: frame + frame),
    st.builds(lambda: lambda _: None),
)

# -- the controller ----------------------------------------------------------------------------------------------------


class Plc:
    """A controller whose memory changes before each read, behind a proxy that changes the answers."""

    def __init__(self, server: S7Server, proxy: FaultProxy, memory: dict[Place, bytearray]) -> None:
        self.server, self.proxy, self.memory = server, proxy, memory
        self.frames = 0
        self.turns = 0
        self._table = TableMemory(LAYOUT)

    def change(self, changes: list[Change]) -> None:
        """Change the next answers, one by each change of the list.

        After the last change, begin again with the first.
        """
        begun = self.frames

        def edit(frame: bytes) -> bytes | None:
            self.frames += 1
            return changes[(self.frames - begun - 1) % len(changes)](frame)

        self.proxy.edit(edit)

    def turn(self) -> dict[str, Value]:
        """Change all bytes of the memory, and return the registers' values.

        No byte equals the return code of a good item, so that data are never mistaken for items.
        """
        self.turns += 1
        with self.server.lock:
            for number, area in enumerate(self.memory.values()):
                area[:] = bytes(0x30 + (7 * number + self.turns + at) % 61 for at in range(SIZE))
        frame = bytearray(LAYOUT.size)
        self._table.load(frame, self.memory)
        return {name: value for name, value in values(LAYOUT, bytes(frame)).items() if name in OWN}


@pytest.fixture(scope="module")
def plc() -> Iterator[Plc]:
    server = S7Server(Address("127.0.0.1", 0), options=ServerOptions(max_pdu_size=240, max_jobs=2))
    memory: dict[Place, bytearray] = {}
    for number in (1, 2, 3):
        memory[Area.BLOCK, number] = bytearray(SIZE)
        server.add_block(number, memory[Area.BLOCK, number])
    for area in (Area.INPUT, Area.MARKER, Area.TIMER):
        memory[area, 0] = bytearray(SIZE)
        server.add_area(AREAS[area], memory[area, 0])
    memory[Area.BLOCK, 9] = bytearray(SIZE)  # is not served
    server.start()
    try:
        with FaultProxy(server.address) as proxy:
            yield Plc(server, proxy, memory)
    finally:
        server.stop()


@contextlib.contextmanager
def connector_of(plc: Plc) -> Iterator[Connector]:
    address = plc.proxy.address
    options = S7Options(host=address.host, port=address.port, timeout=250)  # long enough for a busy host
    with closing(S7Connector.for_layout(LAYOUT)(options, LAYOUT)) as connector:
        yield connector


def read(plc: Plc, connector: Connector) -> set[str]:
    """Read once. Check that good registers have their present values, and return those that are not bad."""
    wanted, usable = plc.turn(), set()
    with contextlib.suppress(ConnectorError):
        if not getattr(connector, "connected", False):
            connector.connect()
        raw = connector.read()
        area, found = StatusArea(LAYOUT), values(LAYOUT, raw)
        for index, register in enumerate(LAYOUT.registers):
            path = register.path
            if quality_of(area.get(raw, index).code) is not Quality.BAD:
                usable.add(path)
                assert path not in wanted or found[path] == wanted[path], path
        assert "gone" not in usable
    return usable


@pytest.fixture(autouse=True)
def tried_again_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.connectors.s7.table.RETRY_NS", 0)


@given(changes=st.lists(CHANGES, min_size=1, max_size=8))
@example(changes=[refused_job(0x8104)])
@example(changes=[of_items(lambda items: [Item(5, 0, 0, b"") for _ in items])])
@example(changes=[of_items(lambda items: [Item(5, 0, 0, b"")] * len(items)), lambda frame: frame])
def test_no_answer_gives_a_wrong_value(plc: Plc, changes: list[Change]) -> None:
    with connector_of(plc) as connector:
        for _ in ("while it connects", "while it reads"):
            plc.change(changes)
            try:
                for _ in range(READS):
                    begun = plc.frames
                    read(plc, connector)
                    assert plc.frames - begun <= 4 * len(TAGS) + SPARE, "requests without end"
                    with contextlib.suppress(ConnectorError):
                        register = LAYOUT.registers[LAYOUT.by_path["set"]]
                        connector.write(encode(register, 5, LAYOUT.byte_order))
            finally:
                plc.proxy.pass_all()
            until(lambda: read(plc, connector).issuperset(OWN), "all registers again")


def test_the_values_of_the_cpu_come_back_in_the_next_session(plc: Plc) -> None:
    """The proxy changes an answer to one question once."""
    with connector_of(plc) as connector:
        changed = 0

        def edit(frame: bytes) -> bytes:
            nonlocal changed
            if frame[8] == 7 and frame[22] == 0x87 and not changed:
                changed += 1
                return frame[:-3] + b"\xff\xff\xff"
            return frame

        plc.proxy.edit(edit)
        area, clock = StatusArea(LAYOUT), LAYOUT.by_path["cpu/clock/text"]
        seen = set()

        def good() -> bool:
            with contextlib.suppress(ConnectorError):
                if not getattr(connector, "connected", False):
                    connector.connect()
                seen.add(area.get(connector.read(), clock).code)
            return 0 in seen

        try:
            until(good, "the clock")
        finally:
            plc.proxy.pass_all()
        assert changed == 1
        assert seen - {0, BAD_WAITING_FOR_INITIAL_DATA}
