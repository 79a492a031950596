"""After any accepted write, exactly the bits of the device that the write names have changed.

Each rig is a device whose every bit is known. Its layouts, its memory and the writes are drawn at
random: registers, elements, slices and bits, one beside the other. Which bits a name means is computed
here from the rules of the protocols, and not by the code under test. The last test breaks connectors on
purpose, and expects that the property finds each of them.
"""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, ClassVar, NamedTuple, Protocol

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from snap7.type import SrvArea

from shmio.config import Address
from shmio.connectors.commands import Item, coalesce
from shmio.connectors.modbus import connector as modbus_module
from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.connectors.models.memory import Memory
from shmio.connectors.mqtt.commands import plan as plan_mqtt
from shmio.connectors.mqtt.options import MqttOptions
from shmio.connectors.mqtt.store import Store
from shmio.connectors.ros.commands import plan as plan_ros
from shmio.connectors.ros.options import TopicOptions
from shmio.connectors.ros.topics import Topics
from shmio.connectors.s7 import connector as s7_module
from shmio.connectors.s7.connector import S7Connector, S7Options
from shmio.emulators import areas as areas_module
from shmio.emulators import modbus as emulator_module
from shmio.emulators.device import Served
from shmio.emulators.modbus import _TableImage
from shmio.emulators.s7 import S7Server
from shmio.layout.addresses.modbus import Table, WordCodec
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.layout.s7 import conversion as conversion_module
from shmio.layout.s7.address import Area
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write, bits_of, encode
from shmio.segment import Command
from shmio.simulation.images import Images
from shmio.testing.write_conformance import write as confirmed
from tests.unit.connectors import hostile
from tests.unit.connectors.modbus.test_limited_devices import Device

Key = tuple[object, ...]
"""Something of a device that a write can change alone: a bit, or a value in a message."""

INTEGERS = {
    "BYTE": 1,
    "SINT": 1,
    "USINT": 1,
    "INT": 2,
    "UINT": 2,
    "WORD": 2,
    "DINT": 4,
    "UDINT": 4,
    "DWORD": 4,
    "LINT": 8,
}
"""Sizes in bytes."""
SIGNED = ("SINT", "INT", "DINT", "LINT")
SIZES = INTEGERS | {"REAL": 4, "LREAL": 8}
SHAPES: Sequence[tuple[int, ...]] = [(), (), (1,), (3,), (8,), (9,), (2, 3), (2, 8), (3, 1)]


class Tag(NamedTuple):
    """A register of a drawn layout."""

    kind: str
    shape: tuple[int, ...]
    place: Any
    """Where the device has it, in the words of the rig."""
    low: int = 0
    """The first index of each dimension."""

    @property
    def type(self) -> str:
        bounds = ", ".join(f"{self.low}..{self.low + length - 1}" for length in self.shape)
        return f"ARRAY[{bounds}] OF {self.kind}" if self.shape else self.kind


class Part(NamedTuple):
    """What a write names: some elements of a register, or one bit of an element."""

    path: str
    elements: range
    bit: int | None
    shape: tuple[int, ...]


Named = tuple[Tag, Part, Value]
"""A write as a program asks for it: the register, the part, and the new value."""
Writer = Callable[[Sequence[Named]], Sequence[str]]
"""Writes to a device, and returns the outcomes: texts, which are empty if the write was accepted."""


class Rig(Protocol):
    """A device whose every bit is known."""

    def layout(self, draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag]]:
        """Draw a layout; fill the device with noise."""

    def state(self) -> Mapping[Key, object]:
        """Return all that the device holds."""

    def keys(self, tag: Tag, part: Part) -> set[Key]:
        """Return what a part of a register takes in the device."""

    def writer(self, layout: Layout) -> AbstractContextManager[Writer]:
        """Return the function that writes to the device."""


def as_commands(layout: Layout, write: Callable[[Sequence[Write]], Sequence[str]]) -> Writer:
    """Let each value be a command of its own, which a source's loop coalesces for its connector."""

    def named(values: Sequence[Named]) -> Sequence[str]:
        items = []
        for number, (_, part, value) in enumerate(values):
            writes = tuple(encode(find(layout, part.path), value, layout.byte_order))
            items += [Item(Command(0, number, 0, 0, writes), place) for place in range(len(writes))]
        batch, _ = coalesce(items, layout.size)
        return write(batch)

    return named


def part_of(draw: st.DataObject, path: str, tag: Tag) -> Part:
    """Draw a part of a register: all of it, a row's slice, an element, or a bit of one."""
    shape, count = tag.shape, math.prod(tag.shape)
    bits = 8 * INTEGERS.get(tag.kind, 0)
    how = draw.draw(
        st.sampled_from(["all", "all", *(["slice", "element"] if shape else []), *(["bit"] if bits else [])])
    )
    if how == "all":
        return Part(path, range(count), None, shape)
    at = draw.draw(st.integers(0, count - 1))
    row, column = divmod(at, shape[-1] if shape else 1)
    index: list[int] = []
    for length in reversed(shape[:-1]):
        row, place = divmod(row, length)
        index.insert(0, place)
    path = "/".join([path, *(str(tag.low + place) for place in index)])
    if how == "slice":
        stop = draw.draw(st.integers(column, shape[-1] - 1))
        columns = f"{tag.low + column}..{tag.low + stop}"
        return Part(f"{path}/{columns}", range(at, at + stop - column + 1), None, (stop - column + 1,))
    path = f"{path}/{tag.low + column}" if shape else path
    if how == "element":
        return Part(path, range(at, at + 1), None, ())
    bit = draw.draw(st.integers(0, bits - 1))
    return Part(f"{path}.%X{bit}", range(at, at + 1), bit, ())


def value_of(draw: st.DataObject, kind: str, part: Part) -> Value:
    """Draw a value for a part of a register of this type."""
    if kind == "BOOL" or part.bit is not None:
        one: st.SearchStrategy[Any] = st.booleans()
    elif kind in INTEGERS:
        size = 8 * INTEGERS[kind]
        one = st.integers(-(1 << size - 1), (1 << size - 1) - 1) if kind in SIGNED else st.integers(0, (1 << size) - 1)
    elif kind == "REAL":
        one = st.floats(width=32, allow_nan=False, allow_infinity=False)
    elif kind == "LREAL":
        one = st.floats(allow_nan=False, allow_infinity=False)
    elif kind == "CHAR":
        one = st.sampled_from("abcXYZ")
    else:
        one = st.text("abcXYZ", max_size=int(kind[7:-1]))
    for length in reversed(part.shape):
        one = st.lists(one, min_size=length, max_size=length)
    value: Value = draw.draw(one)
    return value


def check(rig: Rig, draw: st.DataObject) -> None:
    """Write parts of a drawn layout in a few batches, and compare the device before and after each."""
    layout, tags = rig.layout(draw)
    with rig.writer(layout) as write:
        for _ in range(draw.draw(st.integers(1, 3))):
            parts = []
            for path in draw.draw(st.lists(st.sampled_from(sorted(tags)), min_size=1, max_size=3)):
                part = part_of(draw, path, tags[path])
                parts.append((tags[path], part, value_of(draw, tags[path].kind, part)))
            before = rig.state()
            outcomes = write(parts)
            after = rig.state()
            named = set[Key]().union(*(rig.keys(tag, part) for tag, part, _ in parts))
            changed = {key for key in before.keys() | after.keys() if before.get(key) != after.get(key)}
            assert changed <= named, f"{[part.path for _, part, _ in parts]} changed {changed - named}: {tags}"
            tag, part, value = parts[0]
            if len(parts) == 1 and not any(outcomes) and tag.kind in ("BOOL", *INTEGERS):
                assert not any(write([(tag, part, inverted(value, tag.kind))]))
                last = rig.state()
                assert {key for key in last if last[key] != after.get(key)} == named, part


def inverted(value: Any, kind: str) -> Any:
    """Return a value of a type, all of whose bits differ."""
    if isinstance(value, list):
        return [inverted(one, kind) for one in value]
    if isinstance(value, bool):
        return not value
    return ~value if kind in SIGNED else value ^ (1 << 8 * INTEGERS[kind]) - 1


def random_tags(
    draw: st.DataObject, kinds: Sequence[str], place: Callable[[str, tuple[int, ...]], Any | None]
) -> dict[str, Tag]:
    """Draw some registers. ``place`` draws the place of one, or returns None if it does not fit."""
    tags: dict[str, Tag] = {}
    for number in range(draw.draw(st.integers(2, 8))):
        kind, shape = draw.draw(st.sampled_from(kinds)), draw.draw(st.sampled_from(SHAPES))
        found = place(kind, shape)
        if found is not None:
            tags[f"r{number}"] = Tag(kind, shape, found, draw.draw(st.sampled_from([0, 0, 1])))
    return tags or {"r": Tag("BYTE", (), place("BYTE", ()))}


# -- S7 ----------------------------------------------------------------------------------------------------------------


def s7_size(kind: str) -> int:
    return int(kind[7:-1]) + 2 if kind.startswith("STRING") else SIZES.get(kind, 1)


def s7_span(kind: str, shape: tuple[int, ...]) -> int:
    """Return the bytes of a value in an S7 controller: BOOLs begin each row at a byte, texts at an even byte."""
    if kind == "BOOL":
        return math.prod(shape[:-1]) * -(-shape[-1] // 8) if shape else 1
    size = s7_size(kind)
    return math.prod(shape) * (size + size % 2 if kind.startswith("STRING") else size)


def s7_bits(tag: Tag, part: Part, start: int, first_bit: int = 0) -> set[int]:
    """Return the bits of a part of a value that begins at byte ``start`` of an S7 controller."""
    bits: set[int] = set()
    for element in part.elements:
        if tag.kind == "BOOL":
            row, column = divmod(element, tag.shape[-1] if tag.shape else 1)
            bits.add(8 * (start + row * s7_span("BOOL", tag.shape[-1:]) + column // 8) + column % 8 + first_bit)
            continue
        at, size = start + element * s7_span(tag.kind, ()), s7_size(tag.kind)
        if part.bit is not None:  # numbers are big-endian
            bits.add(8 * (at + size - 1 - part.bit // 8) + part.bit % 8)
        else:
            bits.update(range(8 * at, 8 * (at + size)))
    return bits


S7_KINDS = ("BOOL", "BOOL", *SIZES, "CHAR", "STRING[3]", "STRING[4]")
S7_AREAS = {"%M": SrvArea.MK, "%Q": SrvArea.PA, "DB1.DB": SrvArea.DB}
AREA_BYTES = 48


class S7Rig:
    """A controller with three small memory areas, and a data block."""

    def __init__(self, stack: ExitStack) -> None:
        self.server = S7Server(Address("127.0.0.1", 0))
        self.memory = {name: bytearray(AREA_BYTES) for name in S7_AREAS}
        self.block = bytearray(4096)
        self.server.add_block(1, self.memory["DB1.DB"])
        self.server.add_block(7, self.block)
        self.server.add_area(SrvArea.MK, self.memory["%M"])
        self.server.add_area(SrvArea.PA, self.memory["%Q"])
        self.server.start()
        stack.callback(self.server.stop)

    def layout(self, draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag]]:
        def place(kind: str, shape: tuple[int, ...]) -> tuple[str, int, int] | None:
            room = AREA_BYTES - s7_span(kind, shape)
            if room < 0:
                return None
            bit = draw.draw(st.integers(0, 7)) if kind == "BOOL" and not shape else 0
            return draw.draw(st.sampled_from(sorted(S7_AREAS))), draw.draw(st.integers(0, room)), bit

        tags = random_tags(draw, S7_KINDS, place)
        noise = random.Random(draw.draw(st.integers(0, 1 << 32)))
        for area in self.memory.values():
            area[:] = noise.randbytes(len(area))
        given = {path: {"type": tag.type, "address": s7_address(tag)} for path, tag in tags.items()}
        return place_tags("plant", given).with_statuses(), tags

    def state(self) -> Mapping[Key, object]:
        return {
            (name, 8 * at + bit): byte >> bit & 1
            for name, area in self.memory.items()
            for at, byte in enumerate(area)
            for bit in range(8)
        }

    def keys(self, tag: Tag, part: Part) -> set[Key]:
        name, start, bit = tag.place
        return {(name, one) for one in s7_bits(tag, part, start, bit)}

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        address = self.server.address
        options = S7Options(host=address.host, port=address.port, dbNumber=None if layout.addressed else 7)
        connector: Any = S7Connector.for_layout(layout)(options, layout)
        try:
            connector.connect()
            yield as_commands(layout, lambda writes: confirmed(connector, writes))
        finally:
            connector.close()


def s7_address(tag: Tag) -> str:
    name, start, bit = tag.place
    if tag.kind == "BOOL" and not tag.shape:
        return f"{name}X{start}.{bit}" if name.endswith("DB") else f"{name}{start}.{bit}"
    return f"{name}B{start}"


NAMES = {
    "n_bit": ("zz/3.%X5", Tag("BOOL", (), (3, 5))),
    "n_word": ("zz/4", Tag("WORD", (), (4, 0))),
    "n_bits": ("zz/6.%X2", Tag("BOOL", (12,), (6, 2))),
    "n_slice": ("zz/8..10", Tag("BYTE", (3,), (8, 0))),
    "n_number": ("zz/12", Tag("DINT", (), (12, 0))),
    "n_numbers": ("zz/4", Tag("INT", (5,), (4, 0))),
}
"""Names over an array of bytes: the address, and the register with its first byte and bit in the array."""
MEMBERS = {
    "a": Tag("BOOL", (), ()),
    "b": Tag("BOOL", (), ()),
    "c": Tag("CHAR", (3,), ()),
    "d": Tag("BYTE", (), ()),
    "e": Tag("BOOL", (9,), (), 1),
}
"""Members of a structure in each block."""


def block(draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag], int]:
    """Draw the source of a data block, with a table of names over it.

    Return the layout, the registers with their first byte and bit, and the end of the block.
    """
    tags = random_tags(draw, S7_KINDS, lambda kind, shape: ())

    def declared(registers: Mapping[str, Tag]) -> str:
        return "".join(f"{path} : {tag.type.title().replace(' Of ', ' of ')};\n" for path, tag in registers.items())

    text = "DATA_BLOCK \"DB7\"\n{ S7_Optimized_Access := 'FALSE' }\nVERSION : 0.1\nSTRUCT\n"
    text += f"{declared(tags)}m : Struct\n{declared(MEMBERS)}END_STRUCT;\nzz : Array[0..15] of Byte;\n"
    text += "END_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n"
    names = "".join(
        f'{path} = {{ address = "{address}", type = "{tag.type}" }}\n' for path, (address, tag) in NAMES.items()
    )
    files = [Source("DB7.db", text.encode()), Source("names.toml", f"[registers]\n{names}".encode())]
    (layout,) = compile_sources(files).layouts
    tags |= {f"m/{name}": tag for name, tag in MEMBERS.items()}
    offsets = {one.path: (one.offset, one.bit or 0) for one in layout.registers}
    zz, end = offsets["zz"][0], layout.size + 16
    tags = {path: tag._replace(place=("block", *offsets[path])) for path, tag in tags.items()}
    tags |= {path: tag._replace(place=("block", zz + tag.place[0], tag.place[1])) for path, (_, tag) in NAMES.items()}
    return layout, tags | {"zz": Tag("BYTE", (16,), ("block", zz, 0))}, end


class S7BlockRig(S7Rig):
    """The same controller; the layout is the source of a data block, with a table of names over it."""

    def layout(self, draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag]]:
        layout, tags, self._end = block(draw)
        self.block[:] = random.Random(draw.draw(st.integers(0, 1 << 32))).randbytes(len(self.block))
        return layout, tags

    def state(self) -> Mapping[Key, object]:
        return {
            ("block", 8 * at + bit): byte >> bit & 1
            for at, byte in enumerate(self.block[: self._end])
            for bit in range(8)
        }


class S7EmulatorRig(S7Rig):
    """The program of an emulated controller writes the values that it has changed."""

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        table = areas_module.TableMemory(layout)
        area_of = {"%M": Area.MARKER, "%Q": Area.OUTPUT, "DB1.DB": Area.BLOCK}
        memory = {(area_of[name], 1 if name == "DB1.DB" else 0): area for name, area in self.memory.items()}
        yield as_commands(
            layout,
            lambda writes: stored(
                layout,
                writes,
                lambda frame: table.load(frame, memory),
                lambda before, frame: table.store(before, frame, memory),
            ),
        )


def stored(
    layout: Layout,
    writes: Sequence[Write],
    load: Callable[[bytearray], None],
    store: Callable[[bytes, bytearray], None],
) -> list[str]:
    """Let a program change its image, as a cycle of an emulator does."""
    frame = bytearray(layout.size)
    load(frame)
    before = bytes(frame)
    for offset, mask, data in writes:
        if mask:
            frame[offset] = frame[offset] & ~mask | data[0] & mask
        else:
            frame[offset : offset + len(data)] = data
    store(before, frame)
    return [""] * len(writes)


# -- Modbus ------------------------------------------------------------------------------------------------------------

MODBUS_KINDS = ("BOOL", *SIZES, "STRING[3]", "STRING[4]")
WORDS, COILS = 40, 40


def modbus_width(kind: str) -> int:
    return -(-int(kind[7:-1]) // 2) if kind.startswith("STRING") else max(1, SIZES.get(kind, 1) // 2)


class ModbusRig:
    """A device of a few words and coils. It knows some functions, and has numbers in some order."""

    def __init__(self, stack: ExitStack) -> None:
        self.device = Device()
        self.device.words, self.device.coils = [0] * WORDS, [0] * COILS
        self.address = stack.enter_context(hostile.peer(self.device))

    def layout(self, draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag]]:
        orders = st.sampled_from(["big", "little"])
        self.orders = draw.draw(orders), draw.draw(orders)
        known = draw.draw(st.sampled_from([(5, 6, 15, 16, 22), (5, 6, 15, 16), (15, 16), (5, 6)]))
        self.device.known = {1, 3, *known}

        def place(kind: str, shape: tuple[int, ...]) -> tuple[int, int | None, Any, Any] | None:
            room = (COILS if kind == "BOOL" else WORDS) - math.prod(shape) * modbus_width(kind)
            if room < 0:
                return None
            bit = draw.draw(st.integers(0, 15)) if kind == "BOOL" and not shape and draw.draw(st.booleans()) else None
            own = st.none() | orders
            return (
                draw.draw(st.integers(0, room)),
                bit,
                *((None, None) if kind == "BOOL" else (draw.draw(own), draw.draw(own))),
            )

        tags = random_tags(draw, MODBUS_KINDS, place)
        noise = random.Random(draw.draw(st.integers(0, 1 << 32)))
        self.device.words[:] = [noise.randrange(1 << 16) for _ in range(WORDS)]
        self.device.coils[:] = [noise.randrange(2) for _ in range(COILS)]
        entries: dict[str, object] = {}
        for path, tag in tags.items():
            start, bit, words, octets = tag.place
            where = f"coil {start}" if tag.kind == "BOOL" and bit is None else f"holding {start}"
            entries[path] = {"type": tag.type, "address": where if bit is None else f"{where}.{bit}"} | {
                key: order for key, order in (("word_order", words), ("byte_order", octets)) if order
            }
        return place_tags("plant", entries).with_statuses(), tags

    def state(self) -> Mapping[Key, object]:
        found: dict[Key, object] = {("coil", at): bit for at, bit in enumerate(self.device.coils)}
        for at, word in enumerate(self.device.words):
            found.update({("word", at, bit): word >> bit & 1 for bit in range(16)})
        return found

    def keys(self, tag: Tag, part: Part) -> set[Key]:
        start, bit, words, octets = tag.place
        if tag.kind == "BOOL":
            return {("coil", start + one) for one in part.elements} if bit is None else {("word", start, bit)}
        word_order, byte_order = words or self.orders[0], octets or self.orders[1]
        width, keys = modbus_width(tag.kind), set[Key]()
        text = tag.kind.startswith("STRING")
        size = int(tag.kind[7:-1]) if text else SIZES[tag.kind]
        for element in part.elements:
            for place in range(size):  # of a byte, the most significant first
                pair, low = divmod(place + (size == 1), 2)
                if word_order == "little" and not text:
                    pair = width - 1 - pair
                high = low if byte_order == "little" else 1 - low
                at = start + element * width + pair
                if part.bit is None:
                    keys.update(("word", at, 8 * high + one) for one in range(8))
                elif size - 1 - place == part.bit // 8:
                    keys.add(("word", at, 8 * high + part.bit % 8))
        return keys

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        options: dict[str, Any] = {"word_order": self.orders[0], "byte_order": self.orders[1], "timeout": 20_000}
        address = self.address
        connector = ModbusConnector(ModbusOptions(host=address.host, port=address.port, **options), layout)
        try:
            connector.connect()
            yield as_commands(layout, connector.write)
        finally:
            connector.close()


class ModbusEmulatorRig(ModbusRig):
    """The program of an emulated device writes the values that it has changed."""

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        image = _TableImage(Served(layout, {"word_order": self.orders[0], "byte_order": self.orders[1]}))
        words = {(1, Table.COIL): self.device.coils, (1, Table.HOLDING): self.device.words}
        yield as_commands(
            layout,
            lambda writes: stored(
                layout,
                writes,
                lambda frame: image.load(frame, words),
                lambda before, frame: image.store(before, frame, words),
            ),
        )


# -- messages ----------------------------------------------------------------------------------------------------------


class MessageRig:
    """A device that takes from messages what they name, and keeps the rest. Its values are numbers."""

    TAGS: ClassVar[Mapping[str, Tag]]

    def layout(self, draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag]]:
        given = {path: {"type": tag.type, "address": tag.place[0], "writable": True} for path, tag in self.TAGS.items()}
        self.reset()
        return place_tags("robot", given).with_statuses(), self.TAGS

    def reset(self) -> None:
        raise NotImplementedError

    def document(self) -> Any:
        raise NotImplementedError

    def state(self) -> Mapping[Key, object]:
        return dict(leaves(self.document(), ()))

    def keys(self, tag: Tag, part: Part) -> set[Key]:
        steps = tag.place[1]
        return {(*steps, one) for one in part.elements} if tag.shape else {steps}


def leaves(document: Any, steps: Key) -> Iterator[tuple[Key, object]]:
    if isinstance(document, dict | list):
        for key, value in document.items() if isinstance(document, dict) else enumerate(document):
            yield from leaves(value, (*steps, key))
    else:
        yield steps, document


class MqttRig(MessageRig):
    """A device that reads JSON and text."""

    TAGS: ClassVar[Mapping[str, Tag]] = {
        "speed": Tag("REAL", (), ("t $.a.speed -> s $.a.speed", ("s", "a", "speed"))),
        "count": Tag("INT", (), ("t $.a.count -> s $.a.count", ("s", "a", "count"))),
        "list": Tag("INT", (3,), ("t $.list -> s $.list", ("s", "list"))),
        "flags": Tag("BOOL", (9,), ("t $.flags -> s $.flags", ("s", "flags"))),
        "other": Tag("DINT", (), ("t $.other -> u $", ("u",))),
    }

    def reset(self) -> None:
        inside = {"a": {"speed": 1.5, "count": 2}, "list": [3, 4, 5], "flags": [True] * 9, "unnamed": 7}
        self._document: dict[str, Any] = {"s": inside, "u": 9}

    def document(self) -> Any:
        return self._document

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        options = MqttOptions(url="mqtt://127.0.0.1", max_age_ms=0)
        store = Store(layout, options)

        def write(writes: Sequence[Write]) -> Sequence[str]:
            store.take("t", json.dumps({**self._document["s"], "other": self._document["u"]}).encode(), retained=False)
            commands, outcomes = plan_mqtt(store, options, writes)
            before = copy.deepcopy(self._document)
            for one in commands:
                topic = one.publication.topic
                self._document[topic] = merged(before[topic], json.loads(one.publication.payload))
                before = self._document
            return outcomes

        yield as_commands(layout, write)


def merged(document: Any, change: Any) -> Any:
    """Return a document after a change: members of objects that the change does not have stay as they were."""
    if isinstance(document, dict) and isinstance(change, dict):
        return document | {key: merged(document.get(key), value) for key, value in change.items()}
    return change


class RosRig(MessageRig):
    """A robot that takes whole messages."""

    TAGS: ClassVar[Mapping[str, Tag]] = {
        "x": Tag("LREAL", (), ("/t geometry_msgs/TwistStamped twist.linear.x", ("/t", "twist", "linear", "x"))),
        "z": Tag("REAL", (), ("/t geometry_msgs/TwistStamped twist.angular.z", ("/t", "twist", "angular", "z"))),
        "frame": Tag("STRING[4]", (), ("/t geometry_msgs/TwistStamped header.frame_id", ("/t", "header", "frame_id"))),
        "data": Tag("LREAL", (3,), ("/m std_msgs/Float64MultiArray data", ("/m", "data"))),
    }

    def reset(self) -> None:
        vector = {"x": 1.0, "y": 2.0, "z": 3.0}
        header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "abc"}
        self._document = {
            "/t": {"header": header, "twist": {"linear": dict(vector), "angular": dict(vector)}},
            "/m": {"layout": {"dim": [], "data_offset": 0}, "data": [1.0, 2.0, 3.0]},
        }

    def document(self) -> Any:
        return self._document

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        topics = Topics(layout, TopicOptions(max_age=0), known_types=False)

        def write(writes: Sequence[Write]) -> Sequence[str]:
            for name, message in self._document.items():
                topics.take(name, copy.deepcopy(message), 1, 5)
            publications, outcomes = plan_ros(topics, writes)
            for one in publications:
                self._document[one.topic.name] = one.message
            return outcomes

        yield as_commands(layout, write)


# -- computed values ---------------------------------------------------------------------------------------------------


def noise(draw: st.DataObject, size: int, tags: Mapping[str, Tag]) -> bytes:
    """Draw an image of a block: any bits in its registers; its padding is zero."""
    drawn, image = random.Random(draw.draw(st.integers(0, 1 << 32))), bytearray(size)
    for tag in tags.values():
        _, start, first = tag.place
        for bit in s7_bits(tag, Part("", range(math.prod(tag.shape)), None, tag.shape), start, first):
            image[bit // 8] |= drawn.randrange(2) << bit % 8
    return bytes(image)


class ImageRig:
    """The image of a model or FMU that clients write, or of a source without a device."""

    def layout(self, draw: st.DataObject) -> tuple[Layout, Mapping[str, Tag]]:
        tags = random_tags(draw, S7_KINDS, lambda kind, shape: ())
        layout = place_tags("model", {path: {"type": tag.type} for path, tag in tags.items()}, "big")
        offsets = {one.path: (one.offset, one.bit or 0) for one in layout.registers}
        found = {path: tag._replace(place=("image", *offsets[path])) for path, tag in tags.items()}
        self._image: Any = noise(draw, layout.size, found)
        return layout, found

    keys = S7Rig.keys

    def state(self) -> Mapping[Key, object]:
        return {("image", 8 * at + bit): byte >> bit & 1 for at, byte in enumerate(self._image) for bit in range(8)}

    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        images = Images(layout, ())
        images.resume(self._image)
        self._image = images.commanded
        yield as_commands(layout, images.write)


class MemoryRig(ImageRig):
    @contextmanager
    def writer(self, layout: Layout) -> Iterator[Writer]:
        memory = Memory(Memory.Options(), layout)
        memory.resume(self._image)
        self._image = memory._image
        yield as_commands(layout, memory.write)


RIGS: Mapping[str, Callable[[ExitStack], Any]] = {
    "s7 table": S7Rig,
    "s7 block": S7BlockRig,
    "s7 emulator": S7EmulatorRig,
    "modbus": ModbusRig,
    "modbus emulator": ModbusEmulatorRig,
    "mqtt": lambda _: MqttRig(),
    "ros": lambda _: RosRig(),
    "model": lambda _: ImageRig(),
    "memory": lambda _: MemoryRig(),
}


def run(make: Callable[[ExitStack], Any], **given_settings: Any) -> None:
    """Check the property with drawn layouts and writes."""
    with ExitStack() as stack:
        rig = make(stack)

        @settings(suppress_health_check=list(HealthCheck), deadline=None, database=None, **given_settings)
        @given(st.data())
        def prop(draw: st.DataObject) -> None:
            check(rig, draw)

        prop()


@pytest.mark.parametrize("name", RIGS)
def test_a_write_changes_exactly_what_it_names(name: str) -> None:
    run(RIGS[name])


class WholeWords(WordCodec):
    """Takes a byte for a word."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.masks = (0xFFFF,) * len(self.masks)  # type: ignore[misc]


FAULTY: Mapping[str, tuple[str, Any, str, Any]] = {
    "arrays of bits are written as whole bytes": ("s7 table", conversion_module, "element_bits", bits_of),
    "the padding of a block is written": ("s7 block", s7_module, "covering", lambda _, size, **__: b"\xff" * size),
    "a byte is written as a word": ("modbus", modbus_module, "WordCodec", WholeWords),
    "a program writes a byte as a word": ("modbus emulator", emulator_module, "WordCodec", WholeWords),
}


@pytest.mark.parametrize("what", FAULTY)
def test_a_connector_that_changes_neighbours_is_found(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name, where, attribute, faulty = FAULTY[what]
    monkeypatch.setattr(where, attribute, faulty)
    with pytest.raises(AssertionError, match="changed"):
        run(RIGS[name], phases=[Phase.generate], max_examples=200, report_multiple_bugs=False)
