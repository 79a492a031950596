"""An emulated Modbus device, based on pymodbus's server.

pymodbus decodes the requests and encodes the answers. shmio has its own tables, because the program
must change values, too, which the library's tables do not allow.
"""

from __future__ import annotations

import logging
import struct
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec

from shmio.config.address import Address
from shmio.emulators.cycle import Cycle
from shmio.emulators.device import Served
from shmio.emulators.loop_thread import LoopThread
from shmio.emulators.programs import BUILT_IN, Idle, UserCode, program
from shmio.errors import ConfigError, EndpointError, SnapshotError, ValueRangeError
from shmio.layout.addresses.modbus import MAX_ADDRESS, Order, Table, WordCodec, parse
from shmio.layout.addresses.modbus import Address as Place
from shmio.layout.image import initial_frame
from shmio.layout.model import Register
from shmio.layout.values.codec import codec, flatten, nest
from shmio.model.snapshot import decode_part
from shmio.wording import IN_USE

if TYPE_CHECKING:
    from pymodbus.server import ModbusTcpServer

MAX_CLIENTS: Final = 16
LEAST: Final = 100
"""Minimum number of entries in each table of a unit."""
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS = 1, 2
_READS: Final = {1: Table.COIL, 2: Table.DISCRETE, 3: Table.HOLDING, 4: Table.INPUT}
MASK_WORD: Final = 22
_TABLES: Final = _READS | {5: Table.COIL, 15: Table.COIL} | dict.fromkeys((6, 16, MASK_WORD, 23), Table.HOLDING)
"""The table that each function code reads or writes."""

Where = tuple[int, Table]
Key = tuple[str, str, Any, str, Where]
Words = dict[Where, list[int]]
"""The entries of each table of each unit: a bit as 0 or 1, or a word of 16 bits."""


class _State(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The state of a device in a snapshot: its image, whether clients wrote, its tables, and its program."""

    frame: bytes
    written: bool
    words: list[list[Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)]]]
    program: bytes


class _Place:
    """A register of a tag table, and its entries in the device."""

    def __init__(self, register: Register, address: Place, unit: int, orders: tuple[Order, Order]) -> None:
        self.register, self.address, self.width = register, address, address.width
        self.where = (unit if address.unit is None else address.unit, address.table)
        self._words = None
        if not address.table.of_bits and address.bit is None:
            self._words = WordCodec(address, register, *orders)
        self._starts = range(address.number, self.stop, self.width)
        self._packed = struct.Struct(f">{self.width}H")

    @property
    def swaps(self) -> tuple[bool, bool]:
        """Whether the device has the words, and the bytes of a word, in the order that is not usual."""
        return (False, False) if self._words is None else self._words.swaps

    @property
    def key(self) -> Key:
        """The key by which the register is recognised in another table."""
        register = self.register
        return register.path, register.type, register.dims, register.address, self.where

    @property
    def stop(self) -> int:
        """Number of the entry after the register's last entry."""
        return self.address.number + self.register.count * self.width

    def read(self, entries: Sequence[int]) -> Any:
        """Return the register's value."""
        flat: list[Any] = []
        for at in self._starts:
            if self._words is None:
                flat.append(bool(entries[at] >> (self.address.bit or 0) & 1))
            else:
                flat.append(self._words.decode(self._packed.pack(*entries[at : at + self.width])))
        return nest(flat, self.register.shape) if self.register.dims else flat[0]

    def write(self, entries: list[int], value: Any, before: Any = None) -> None:
        """Store those elements of the register's value that differ from the value ``before``, if there is one.

        Raises:
            ValueError: The device's type cannot hold an element.

        """
        flat = self._flat(value)
        old = [None] * len(flat) if before is None else self._flat(before)
        for at, one, was in zip(self._starts, flat, old, strict=True):
            if one == was:
                continue
            if self._words is None:
                mask = 1 << (self.address.bit or 0)
                entries[at] = entries[at] & ~mask | (mask if one else 0)
            else:
                for place, (mask, word) in enumerate(
                    zip(self._words.masks, self._packed.unpack(self._words.encode(one)), strict=True), at
                ):
                    entries[place] = entries[place] & ~mask | word & mask

    def _flat(self, value: Any) -> list[Any]:
        register = self.register
        return list(flatten(value, register.shape, register.path)) if register.dims else [value]


class _TableImage:
    """Copies the registers of a tag table between an image and the device's tables."""

    def __init__(self, served: Served) -> None:
        """Find the place of each register.

        Raises:
            ConfigError: An address is wrong.

        """
        self.layout = layout = served.layout
        options = served.options
        unit, orders = options.get("unit", 1), (options.get("word_order", "big"), options.get("byte_order", "big"))
        self.places: list[_Place] = []
        for register in layout.registers:
            try:
                self.places.append(_Place(register, parse(register), unit, orders))
            except ValueError as error:
                raise ConfigError(f"layout: {register.path}: {error}") from None
        self._spans = [(one.offset, one.offset + one.size) for one in layout.registers]
        self._codecs = [codec(register, layout.byte_order) for register in layout.registers]

    def fill(self, words: Words, known: Collection[Key], sizes: Mapping[Where, int]) -> None:
        """Store the initial values. Those of the tag table override the defaults of the types.

        Args:
            words: The tables.
            known: The registers that have values already.
            sizes: The sizes of those parts of the tables that have values, which defaults do not override.

        """
        frame, _ = initial_frame(self.layout)
        for given in (False, True):
            chosen = [
                place.key not in known
                and (place.register.initial is not None) is given
                and (given or place.stop > sizes.get(place.where, 0))
                for place in self.places
            ]
            self._store(words, frame, chosen)

    def load(self, frame: bytearray, words: Words) -> None:
        """Copy the values of the device to an image."""
        for place, own in zip(self.places, self._codecs, strict=True):
            with suppress(ValueRangeError):
                own.encode_into(place.read(words[place.where]), frame)

    def store(self, before: bytes, frame: bytearray, words: Words) -> None:
        """Copy the changed values of an image to the device; of an array, only the changed elements."""
        self._store(words, frame, [before[start:stop] != frame[start:stop] for start, stop in self._spans], before)

    def _store(self, words: Words, frame: bytearray, chosen: Sequence[bool], before: bytes | None = None) -> None:
        for place, own, one in zip(self.places, self._codecs, chosen, strict=True):
            if one:
                with suppress(ValueError, ValueRangeError):  # for example, the scale has no raw value for 0
                    place.write(words[place.where], own.decode(frame), None if before is None else own.decode(before))


class ModbusEmulator:
    """Runs a program on one tag table, and serves the registers of this and further tables.

    You can start an emulator only once.
    """

    def __init__(
        self, served: Sequence[Served], program_name: str, listen: Address, *, code: UserCode = BUILT_IN
    ) -> None:
        """Prepare the emulator.

        Args:
            served: The tag tables; the program runs on the first.
            program_name: The program to run.
            listen: The address to listen on.
            code: Folder and parameters of the program if it is a class of the user.

        Raises:
            ConfigError: There is no such program, the table does not suit it, or an address is
                wrong.

        """
        self.address = listen
        self._framing = _framing_of(served)
        self._code, self._program_name = code, program_name
        self._words: Words = {}
        self._lock = threading.Lock()
        self._store = _Store(self._words, self._lock)
        self._serve_tables(served)
        self._loop = LoopThread("modbus-server")
        self._server: ModbusTcpServer | None = None
        self.cycle = Cycle(self._program.period_ms / 1000, self._step, f"program-{program_name}")

    def _serve_tables(self, served: Sequence[Served], known: Mapping[Key, _Place] = MappingProxyType({})) -> None:
        """Serve tables, with the initial values of registers that are not ``known``."""
        images = [_TableImage(one) for one in served]
        places = _by_key(images)
        made = program(self._program_name, served[0].layout, self._code)
        words: Words = {}
        for image in images:
            for place in image.places:
                entries = words.setdefault(place.where, [0] * LEAST)
                entries += [0] * (place.stop - len(entries))
        for where, entries in words.items():
            before = self._words.get(where, [])[: len(entries)]
            entries[: len(before)] = before
        for key in places.keys() & known.keys():
            place, old = places[key], known[key]
            if place.swaps != old.swaps:
                with suppress(ValueError):
                    place.write(words[place.where], old.read(self._words[old.where]))
        sizes = {where: len(entries) for where, entries in self._words.items()}
        for image in images:
            image.fill(words, known, sizes)
        self._images, self._program = images, made
        self._frame = bytearray(served[0].layout.size)
        self._store.replace(words)

    def change(self, served: Sequence[Served]) -> None:
        """Serve other tables from now on. Entries that are served before and after keep their values."""
        if _framing_of(served) != self._framing:
            raise ConfigError("framing: restart the instance to change the framing of an emulated device")
        with self._lock:
            self._serve_tables(served, _by_key(self._images))

    def start(self) -> None:
        """Run the first cycle, listen, and continue in threads.

        Raises:
            EndpointError: The address is not available.

        """
        self.cycle.first()
        self._loop.start()
        self._loop.run(self._serve)
        self.cycle.start()

    def stop(self) -> None:
        """Stop the server and the program; return when all threads have ended."""
        self.cycle.stop()
        if self._server is not None:
            self._loop.run(self._server.shutdown)
        self._loop.stop()

    def save(self) -> bytes:
        """Return the state of the tables and the program, for a snapshot."""
        with self._lock:
            words = list(self._words.values())
            return msgspec.msgpack.encode(_State(bytes(self._frame), self._store.written, words, self._program.save()))

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check a state, and return the function that restores it."""
        state = decode_part(data, _State)
        tables = list(self._words.values())
        if len(state.frame) != len(self._frame) or list(map(len, state.words)) != list(map(len, tables)):
            raise SnapshotError("its tables have other sizes")
        restore_program = self._program.prepare_restore(state.program)

        def restore() -> None:
            with self._lock:
                restore_program()
                self._frame[:] = state.frame
                self._store.written = state.written
                for table, entries in zip(tables, state.words, strict=True):
                    table[:] = entries

        return restore

    async def _serve(self) -> None:
        from pymodbus import FramerType  # noqa: PLC0415  it needs the extra
        from pymodbus.server import ModbusTcpServer  # noqa: PLC0415
        from pymodbus.simulator import DataType, SimData, SimDevice  # noqa: PLC0415

        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # the library logs errors of clients
        nothing = SimDevice(0, simdata=[SimData(0, datatype=DataType.REGISTERS)])
        framer = FramerType.RTU if self._framing == "rtu" else FramerType.SOCKET
        server: Any = ModbusTcpServer(nothing, framer=framer, address=(self.address.host, self.address.port))
        server.context = self._store
        connected = server.callback_new_connection

        def make_room() -> None:
            clients = list(server.active_connections.values())
            if len(clients) > MAX_CLIENTS:  # end the oldest that has sent no request, or else the newest
                next((one for one in clients if one.last_pdu is None), clients[-1]).close()

        def connect() -> Any:
            server.loop.call_soon(server.loop.call_soon, make_room)  # once the handler has its connection
            return connected()

        server.callback_new_connection = connect
        if not await server.listen():
            raise EndpointError(f"cannot listen on {self.address}: {IN_USE}")
        self._server = server

    def _step(self, time_s: float) -> None:
        if isinstance(self._program, Idle):
            return
        image = self._images[0]
        with self._lock:
            if self._store.written:  # else the frame has the device's values already
                self._store.written = False
                image.load(self._frame, self._words)
            before = bytes(self._frame)
            self._program.step(time_s, self._frame)
            image.store(before, self._frame, self._words)


def _by_key(images: Sequence[_TableImage]) -> dict[Key, _Place]:
    """Return the registers of tables by their keys. Raise ConfigError if one has two orders of words or bytes."""
    found: dict[Key, _Place] = {}
    for place in (place for image in images for place in image.places):
        if found.setdefault(place.key, place).swaps != place.swaps:
            raise ConfigError(
                f"layout: {place.register.path}: the sources that read this register of unit {place.where[0]} differ "
                "in word_order or byte_order; give them the same, or give each its own emulator"
            )
    return found


def _framing_of(served: Sequence[Served]) -> str:
    """Return the framing of the sources that read a device. Raise ConfigError if they differ."""
    found = {str(one.options.get("framing", "tcp")) for one in served}
    if len(found) > 1:
        raise ConfigError("framing: the sources of one device must have the same framing; give each its own emulator")
    return found.pop()


class _Store:
    """The device's tables, with the methods that pymodbus's server calls. The first entry is number 0."""

    def __init__(self, words: Words, lock: threading.Lock) -> None:
        self._words, self._lock = words, lock
        self.written = True
        """True if the tables may differ from the program's image: at first, and after a client has written."""
        self._units = {unit for unit, _ in words}
        self._masked = 0  # the word that pymodbus changes next, for function 22

    def replace(self, words: Words) -> None:
        """Serve these tables from now on."""
        self._words.clear()
        self._words.update(words)
        self._units = {unit for unit, _ in words}
        self.written = True

    def device_ids(self) -> list[int]:
        """Return the unit ids."""
        return sorted(self._units)

    async def async_getValues(  # noqa: N802
        self, unit: int, function: int, address: int, count: int = 1
    ) -> list[int] | list[bool] | Any:
        """Return entries of a function's table, or an exception code."""
        entries = self._entries(unit, function, address, count)
        if not isinstance(entries, list):
            return entries
        with self._lock:
            found = entries[address : address + count]
        if function == MASK_WORD:
            self._masked = found[0]
        return [bool(one) for one in found] if _TABLES[function].of_bits else found

    async def async_setValues(self, unit: int, function: int, address: int, values: Sequence[int]) -> Any:  # noqa: N802
        """Store entries of a function's table. Return None or an exception code."""
        entries = self._entries(unit, function, address, len(values))
        if not isinstance(entries, list):
            return entries
        with self._lock:
            if function == MASK_WORD:  # the program may have changed other bits since pymodbus read the word
                changed = self._masked ^ values[0]
                values = [entries[address] & ~changed | values[0] & changed]
            entries[address : address + len(values)] = [int(one) for one in values]
            self.written = True
        return None

    def _entries(self, unit: int, function: int, address: int, count: int) -> list[int] | Any:
        from pymodbus.constants import ExcCodes  # noqa: PLC0415  it needs the extra
        from pymodbus.exceptions import NoSuchIdException  # noqa: PLC0415

        if unit not in self._units:
            raise NoSuchIdException(f"no unit {unit}")
        if function not in _TABLES:
            return ExcCodes(_ILLEGAL_FUNCTION)
        entries = self._words.get((unit, _TABLES[function]), ())
        if count < 1 or address < 0 or address + count > min(len(entries), MAX_ADDRESS + 1):
            return ExcCodes(_ILLEGAL_ADDRESS)
        return entries
