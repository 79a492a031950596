"""The connector ``modbus``: reads the addresses of a tag table, and writes to them."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Iterator, Sequence
from functools import reduce
from operator import or_
from typing import Annotated, Any, Final, NamedTuple

import msgspec
import numpy as np

from shmio.connectors.base import Connector, Lost, WriteLostError
from shmio.connectors.modbus import client
from shmio.connectors.modbus.client import (
    MAX_WRITE_BITS,
    MAX_WRITE_WORDS,
    Framing,
    ModbusClient,
    RefusedError,
    SilentError,
)
from shmio.connectors.modbus.plan import MAX_PROBES, Element, Limits, ReadRequest, Refusals
from shmio.connectors.register_image import Copy, RegisterImage, no_status_area
from shmio.connectors.request_count import CycleRequests, Requests
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.addresses.modbus import Address, Order, Table, WordCodec, parse
from shmio.layout.model import Layout, Register, bit_positions
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write, apply
from shmio.model.statuses import (
    BAD_COMMUNICATION_ERROR,
    BAD_DEVICE_FAILURE,
    BAD_NO_COMMUNICATION,
    BAD_NOT_SUPPORTED,
    BAD_OUT_OF_RANGE,
    BAD_RESOURCE_UNAVAILABLE,
    BAD_TIMEOUT,
)
from shmio.wording import counted

GATEWAY_RETRY_NS: Final = 1_000_000_000
"""First pause before a silent unit is asked again; it doubles with each further attempt."""
MAX_UNIT_RETRY_NS: Final = 10_000_000_000
"""Longest pause before a silent unit is asked again."""
MAX_COPIES: Final = 10_000
"""Maximum number of requests for which the connector remembers where their bytes belong in the image."""
_STATUS: Final = {
    client.ILLEGAL_FUNCTION: BAD_NOT_SUPPORTED,
    client.ILLEGAL_ADDRESS: BAD_OUT_OF_RANGE,
    client.ILLEGAL_VALUE: BAD_OUT_OF_RANGE,
    client.DEVICE_FAILURE: BAD_DEVICE_FAILURE,
    client.PARITY: BAD_DEVICE_FAILURE,
    client.ACKNOWLEDGE: BAD_RESOURCE_UNAVAILABLE,
    client.BUSY: BAD_RESOURCE_UNAVAILABLE,
    client.NO_PATH: BAD_NO_COMMUNICATION,
    client.NO_ANSWER: BAD_TIMEOUT,
}
_OF_ADDRESSES: Final = frozenset(
    {client.ILLEGAL_FUNCTION, client.ILLEGAL_ADDRESS, client.ILLEGAL_VALUE, client.DEVICE_FAILURE, client.PARITY}
)
"""Exceptions that a device may send because it refuses some addresses of a request."""
_OF_UNITS: Final = frozenset({client.NO_PATH, client.NO_ANSWER})
_TABLE_NAMES: Final = {
    Table.HOLDING: "holding register", Table.INPUT: "input register", Table.COIL: "coil",
    Table.DISCRETE: "discrete input",
}  # fmt: skip
NOTE: Final = "addresses that the device refuses take more requests"
_WORD: Final = 0xFFFF
_INSTEAD: Final = {
    client.WRITE_COIL: (client.WRITE_COILS, "shmio writes single coils by function 15"),
    client.WRITE_COILS: (client.WRITE_COIL, "shmio writes coils one after the other, by function 5"),
    client.WRITE_WORD: (client.WRITE_WORDS, "shmio writes single words by function 16"),
    client.WRITE_WORDS: (
        client.WRITE_WORD,
        "shmio writes words one after the other, by function 6, so the device may see the half of a number",
    ),
    client.MASK_WORD: (client.WRITE_WORD, "to write a part of a word, shmio reads the word and writes it back"),
}
"""For each function, the one to use if a device does not know it, and the effect, for the log."""

log = logging.getLogger("shmio.source")


class ModbusOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Address of the device, and its limits."""

    host: Annotated[str, msgspec.Meta(min_length=1, max_length=253)]
    port: Annotated[int, msgspec.Meta(ge=1, le=65535)] = 502
    timeout: Annotated[int, msgspec.Meta(ge=1, le=600_000)] = 2000
    """Time-out in ms for connecting, for reading all registers, and for the writes of a cycle."""
    unit: Annotated[int, msgspec.Meta(ge=0, le=255)] = 1
    """Unit id for addresses that name no unit."""
    framing: Framing = "tcp"
    """Frames of the device: those of Modbus TCP, or those of a serial line (RTU), sent over TCP."""
    word_order: Order = "big"
    """Order of the words within a number. With ``big``, the highest word comes first. A tag may have its own."""
    byte_order: Order = "big"
    """Order of the bytes within a word. The protocol specifies ``big``. A tag may have its own."""
    max_registers: Annotated[int, msgspec.Meta(ge=1, le=125)] = 125
    """Maximum number of words in a request."""
    max_bits: Annotated[int, msgspec.Meta(ge=1, le=2000)] = 2000
    """Maximum number of coils or discrete inputs in a request."""
    max_gap: Annotated[int, msgspec.Meta(ge=0, le=124)] = 16
    """Maximum number of unused words, or bits, that a request reads to save another request."""


class _Silence(NamedTuple):
    """A unit that does not answer."""

    until_ns: int
    """Time of the next attempt, in ns of CLOCK_MONOTONIC."""
    pause_ns: int
    """Length of the present pause."""
    status: int
    mute: bool
    """True if no answer came at all; False if the gateway reported the silence, so that the connection is alive."""


class _Register:
    """A register with its address, and its elements in the device."""

    def __init__(self, index: int, register: Register, address: Address, options: ModbusOptions) -> None:
        self.index, self.register, self.address = index, register, address
        self.unit = options.unit if address.unit is None else address.unit
        self.codec = None
        if not address.table.of_bits and address.bit is None:
            self.codec = WordCodec(address, register, options.word_order, options.byte_order)

    def byte_places(self, byte_order: str) -> list[int] | None:
        """Return for each byte of the register in the image its place in the device's words.

        Return None if the value must be converted.
        """
        register, size = self.register, self.register.size
        if self.codec is None or register.dims or register.scale or self.address.kind is not register.element:
            return None
        if register.element.base == "STRING" or size != 2 * self.address.width:
            return None
        places = list(self.codec.ordered(bytes(range(size))))
        return places if byte_order == "big" else places[::-1]

    def element(self, place: int) -> Element:
        address = self.address
        start = address.number + place * address.width
        return Element(self.unit, address.table, start, address.width, self.index, place)

    def value(self, data: bytes, at: int) -> Any:
        """Decode an element that begins at entry ``at`` of a request's bytes."""
        if self.address.table.of_bits:
            return bool(data[at // 8] >> at % 8 & 1)
        if self.codec is None:
            return bool(int.from_bytes(data[2 * at : 2 * at + 2], "big") >> (self.address.bit or 0) & 1)
        return self.codec.decode(data[2 * at : 2 * (at + self.address.width)])


class ModbusConnector(Connector):
    """Reads all registers of a layout in each cycle.

    If the device refuses a request, the connector splits it until it finds the refused addresses.
    Only the registers at these addresses are bad. The connector tries the addresses again every 10
    s, also on a new connection. It waits for a silent unit for this unit's share of the time-out,
    and asks the unit again after 1 s, and later after up to 10 s.
    """

    Options = ModbusOptions
    can_write = True
    register_quality = True
    cannot_browse = (
        "a Modbus device has neither names nor types to list; write a tag table from the device's manual, or convert "
        "its tag list with shmio-layout import"
    )
    register_options = frozenset({"unit", "word_order", "byte_order", "max_registers", "max_bits", "max_gap"})

    def __init__(self, options: ModbusOptions, layout: Layout) -> None:
        self._options, self._layout = options, layout
        self._client = ModbusClient(options.host, options.port, options.timeout, options.framing)
        self._registers: list[_Register] = []
        for index, register in enumerate(layout.registers):
            try:
                address = parse(register)
                if register.writable and not address.table.writable:
                    raise ValueError(f"nothing can be written to the table {address.table.value}")
            except ValueError as error:
                raise ConfigError(f"layout: {register.path}: {error}") from None
            self._registers.append(_Register(index, register, address, options))
        limits = Limits(options.max_registers, options.max_bits, options.max_gap)
        elements = [one.element(place) for one in self._registers for place in range(one.register.count)]
        try:
            self._refusals = Refusals(elements, limits)
        except ValueError as error:
            raise ConfigError(f"layout: {error}; raise max_registers or max_bits") from None
        self._image = RegisterImage(layout) if layout.status_offset is not None else None
        self._byte_places = {
            one.index: places for one in self._registers if (places := one.byte_places(layout.byte_order)) is not None
        }
        self._converted = [one for one in self._registers if one.index not in self._byte_places]
        self._copies: dict[ReadRequest, Copy] = {}
        self._units = sorted({one.unit for one in self._registers})
        self._silent: dict[int, _Silence] = {}
        self._probes = 0  # number of probes that this cycle may still send
        self._unknown: dict[int, set[int]] = {}  # by unit: the write functions that it does not know

    @property
    def timeout_s(self) -> float:
        """The longest time that any method may block, in s."""
        return self._options.timeout / 1000

    def describe(self) -> str:
        """Return, for the log, the peer and the number of requests in a cycle."""
        return f"to {self._client.peer} in {len(self._refusals.requests)} requests a cycle"

    def cycle_requests(self) -> CycleRequests:
        """Return the requests that read all registers."""
        counts: dict[Table, int] = {}
        for request in self._refusals.requests:
            counts[request.table] = counts.get(request.table, 0) + request.count
        what = ", ".join(counted(counts[table], name) for table, name in _TABLE_NAMES.items() if table in counts)
        units = sorted({request.unit for request in self._refusals.requests})
        some = f"unit {units[0]}" if len(units) == 1 else f"{len(units)} units"
        return CycleRequests(f"{what} of {some}", (Requests(len(self._refusals.requests)),), NOTE)

    def connect(self) -> None:
        """Connect to the device. Raise ConnectorError if it cannot be reached."""
        self._client.connect()
        self._silent.clear()
        self._unknown.clear()

    def take_over(self, other: ModbusConnector) -> bool:
        """Take over the connection of another connector, and its knowledge about the units."""
        if not other._client.connected:
            return False
        self._client, other._client = other._client, self._client
        self._silent = {unit: silence for unit, silence in other._silent.items() if unit in self._units}
        self._unknown = other._unknown
        return True

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    # -- reading -------------------------------------------------------------------------------------------------------

    def read(self) -> bytes:
        """Read all registers. Raise ConnectorError if the connection is lost."""
        if self._image is None:
            raise no_status_area()
        self._client.begin()
        now_ns = time.monotonic_ns()
        values: dict[int, list[Any]] = {}
        failed = {one.register: status for one, (_, status) in self._refusals.refused.items()}
        self._probes = MAX_PROBES
        requests: dict[int, list[ReadRequest]] = {}
        for request in self._refusals.requests:
            requests.setdefault(request.unit, []).append(request)
        asked = self._asked(requests, now_ns)
        for unit in requests.keys() - asked:
            failed.update((one.register, self._silent[unit].status) for some in requests[unit] for one in some.elements)
        for place, unit in enumerate(asked):
            until_ns = self._until_ns(len(asked) - place)
            for request in requests[unit]:
                self._fetch(request, now_ns, until_ns, values, failed, self._image)
        for request in self._refusals.due(now_ns, self._probes):
            self._try_again(request, now_ns)
        if len(self._silent) == len(self._units) and all(one.mute for one in self._silent.values()):
            self._client.close()
            raise ConnectorError(f"no answer from any of {len(self._units)} units at {self._client.peer}")
        for index, status in failed.items():
            self._image.fail(index, status)
        for one in self._converted:
            if one.index not in failed:
                found = values[one.index]
                value: Value = _nested(found, one.register.shape) if one.register.dims else found[0]
                self._image.put(one.index, value)
        return bytes(self._image)

    def _asked(self, units: Collection[int], now_ns: int) -> list[int]:
        """Return the units to ask in this cycle: those that answer, then at most one silent unit."""
        due = [unit for unit in self._silent if unit in units and self._silent[unit].until_ns <= now_ns]
        due.sort(key=lambda unit: self._silent[unit].until_ns)
        return [unit for unit in units if unit not in self._silent] + due[:1]

    def _until_ns(self, units: int) -> int | None:
        """Return the deadline for the next unit, in ns of CLOCK_MONOTONIC; None for the whole time-out.

        ``units`` is the number of units still to read. They share the rest of the time-out, so that
        a silent unit leaves time for the others.
        """
        if len(self._units) == 1:
            return None
        share_ns = self._client.left_ns // units
        return time.monotonic_ns() + min(share_ns, self._options.timeout * 1_000_000 // len(self._units))

    def _fell_silent(self, unit: int, status: int, error: ConnectorError, *, mute: bool) -> None:
        """Pause before the next request to a unit. The pause grows with each attempt."""
        before = self._silent.get(unit)
        if before is None:
            log.warning("unit %d: %s; its registers are bad until it answers", unit, error)
        pause_ns = min(2 * before.pause_ns, MAX_UNIT_RETRY_NS) if before else GATEWAY_RETRY_NS
        self._silent[unit] = _Silence(time.monotonic_ns() + pause_ns, pause_ns, status, mute)

    def _answered(self, unit: int) -> None:
        if self._silent.pop(unit, None):
            log.info("unit %d answers again", unit)

    def _fetch(
        self,
        request: ReadRequest,
        now_ns: int,
        until_ns: int | None,
        values: dict[int, list[Any]],
        failed: dict[int, int],
        image: RegisterImage,
    ) -> None:
        """Read a request's elements. If the device refuses the request, search for the refused addresses.

        If the search needs more than ``MAX_PROBES`` requests, or more than half of the time-out, it
        continues in the next cycles.
        """
        silence = self._silent.get(request.unit)
        if silence is not None and silence.until_ns > now_ns:
            failed.update((one.register, silence.status) for one in request.elements)
            return
        if (suspicion := self._refusals.suspects.get(request)) is not None:
            if not self._may_probe(now_ns):
                failed.update((one.register, suspicion) for one in request.elements)
                return
            self._probes -= 1
        try:
            data = self._client.read(request.unit, request.table, request.start, request.count, until_ns)
        except SilentError as error:
            self._fell_silent(request.unit, BAD_TIMEOUT, error, mute=True)
            failed.update((one.register, BAD_TIMEOUT) for one in request.elements)
            return
        except RefusedError as error:
            status = _STATUS.get(error.code, BAD_COMMUNICATION_ERROR)
            if error.code in _OF_UNITS:
                self._fell_silent(request.unit, status, error, mute=False)
                failed.update((one.register, status) for one in request.elements)
                return
            self._answered(request.unit)
            if error.code in _OF_ADDRESSES:
                parts = self._refusals.split(request, status)
                if len(parts) > 1:
                    for part in parts:
                        self._fetch(part, now_ns, until_ns, values, failed, image)
                    return
                first = len(parts) == 1 and self._refusals.refuse(request, status, now_ns)
            else:
                first = True
            if first:
                log.warning("%s: %s", self._named(request), error)
            failed.update((one.register, status) for one in request.elements)
            return
        self._answered(request.unit)
        self._refusals.suspects.pop(request, None)
        copy = self._copies.get(request)
        if copy is None:
            if len(self._copies) > MAX_COPIES:
                self._copies.clear()  # requests change while the connector searches for refused addresses
            copy = self._copies[request] = self._copy_of(request)
        image.copy(copy, data)
        for one in request.elements:
            if one.register in copy.indices:
                continue
            register = self._registers[one.register]
            found = values.setdefault(one.register, [None] * register.register.count)
            found[one.place] = register.value(data, one.start - request.start)

    def _copy_of(self, request: ReadRequest) -> Copy:
        """Return which bytes of an answer go to which bytes of the image."""
        sources: list[int] = []
        targets: list[int] = []
        indices = []
        for one in request.elements:
            if (places := self._byte_places.get(one.register)) is not None:
                offset, first = self._registers[one.register].register.offset, 2 * (one.start - request.start)
                sources += (first + place for place in places)
                targets += range(offset, offset + len(places))
                indices.append(one.register)
        return Copy(np.array(sources, np.intp), np.array(targets, np.intp), frozenset(indices))

    def _may_probe(self, now_ns: int) -> bool:
        """Return whether this cycle may send probes in addition to its requests."""
        used_ns = time.monotonic_ns() - now_ns
        return self._probes > 0 and used_ns < self._options.timeout * 500_000

    def _try_again(self, request: ReadRequest, now_ns: int) -> None:
        """Read a refused address alone. If the device answers, the next cycles read it with the others."""
        if request.unit in self._silent or not self._may_probe(now_ns):
            return
        self._probes -= 1
        try:
            self._client.read(request.unit, request.table, request.start, request.count, self._until_ns(1))
        except SilentError as error:
            self._fell_silent(request.unit, BAD_TIMEOUT, error, mute=True)
        except RefusedError as error:
            self._refusals.refuse(request, _STATUS.get(error.code, BAD_COMMUNICATION_ERROR), now_ns)
        else:
            log.info("%s can be read again", self._named(request))
            self._refusals.accept(request)

    def _named(self, request: ReadRequest) -> str:
        first = self._registers[request.elements[0].register].register.path
        more = f" and {len(request.elements) - 1} more" if len(request.elements) > 1 else ""
        return f"{first}{more} (unit {request.unit}, {request.table.value} {request.start})"

    # -- writing -------------------------------------------------------------------------------------------------------

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Write to the device, one write after the other: see :meth:`Connector.write`.

        If several writes together make up a whole value, the connector joins them into one write,
        and sends it in place of the last one.
        """
        if not self._client.connected:
            raise WriteLostError(f"not connected to {self._client.peer}", [Lost.UNSENT] * len(writes))
        self._client.begin()
        outcomes: list[str | Lost] = [Lost.UNSENT] * len(writes)
        for places in self._joined(writes):
            done = False
            try:
                reason: str | Lost = ""
                for step in self._steps([writes[place] for place in places]):
                    for _ in self._exchange(*step):
                        done = True
            except (RefusedError, ValueError) as error:
                reason = f"only a part was written, and then: {error}" if done else str(error)
            except ConnectorError as error:
                reason = Lost.UNSENT if not (done or self._client.sent) else Lost.UNKNOWN
                for place in places:
                    outcomes[place] = reason
                raise WriteLostError(str(error), outcomes) from None
            for place in places:
                outcomes[place] = reason
        return [str(outcome) for outcome in outcomes]

    def _joined(self, writes: Sequence[Write]) -> list[list[int]]:
        """Group the indices of the writes that are joined to one write, in the order of writing.

        For example, if one command writes a word and another one of its bits, the write of the word
        lacks that bit. Writes of a value are joined only if together they contain all its bits.
        """
        group = list(range(len(writes)))  # for each write, the last write of its group
        for one in self._registers:
            register = one.register
            near = [place for place, write in enumerate(writes) if _touches(write, register)]
            if len(near) < 2 or register.type == "BOOL":
                continue
            for at in {at for place in near for at in _cut(writes[place], register)}:
                shares = {place: _share(writes[place], at, register.element.size) for place in near}
                some = [place for place, share in shares.items() if any(share)]
                if all(reduce(or_, column) == 0xFF for column in zip(*(shares[place] for place in some), strict=True)):
                    joined = {group[place] for place in some}
                    last = max(joined)
                    group = [last if member in joined else member for member in group]
        found: dict[int, list[int]] = {}
        for place, last in enumerate(group):
            found.setdefault(last, []).append(place)
        return [found[last] for last in sorted(found)]

    def _exchange(self, unit: int, function: int, data: bytes) -> Iterator[None]:
        """Send the request of a write, and yield after each part that the device has confirmed.

        If the device does not know the function, use another one instead, and remember that.
        """
        unknown = self._unknown.setdefault(unit, set())
        if function not in unknown:
            try:
                self._client.write(unit, function, data)
            except RefusedError as error:
                if error.code != client.ILLEGAL_FUNCTION:
                    raise
            else:
                yield
                return
        instead, effect = _INSTEAD[function]
        try:
            for request in self._other_requests(unit, function, data):
                if function == client.MASK_WORD:
                    yield from self._exchange(unit, instead, request)
                else:
                    self._client.write(unit, instead, request)
                    yield
        except RefusedError as error:
            if error.code != client.ILLEGAL_FUNCTION:
                raise
            unknown.discard(function)  # the cause may be the address; some devices mix up the exceptions
            raise RefusedError(error.code, function, *error.functions) from None
        if function not in unknown:
            unknown.add(function)
            log.warning("unit %d does not know function %d: %s", unit, function, effect)

    def _other_requests(self, unit: int, function: int, data: bytes) -> Iterator[bytes]:
        """Yield the data of the requests that together have the effect of another function."""
        start, value = int.from_bytes(data[:2], "big"), data[2:4]
        if function == client.MASK_WORD:
            keep, put = int.from_bytes(value, "big"), int.from_bytes(data[4:6], "big")
            word = int.from_bytes(self._client.read(unit, Table.HOLDING, start, 1), "big")
            yield data[:2] + (word & keep | put).to_bytes(2, "big")
        elif function == client.WRITE_WORD:
            yield data[:2] + b"\0\1\2" + value
        elif function == client.WRITE_COIL:
            yield data[:2] + b"\0\1\1" + (b"\1" if value[0] else b"\0")
        else:
            for place in range(int.from_bytes(value, "big")):
                if function == client.WRITE_WORDS:
                    one = data[5 + 2 * place : 7 + 2 * place]
                else:
                    one = b"\xff\0" if data[5 + place // 8] >> place % 8 & 1 else b"\0\0"
                yield (start + place).to_bytes(2, "big") + one

    def _steps(self, writes: Sequence[Write]) -> Iterator[tuple[int, int, bytes]]:
        """Yield the requests (unit, function, data) of joined writes.

        Raises:
            ValueError: The device cannot hold the value, or nothing can be written at these bytes.

        """
        found = False
        for one in self._registers:
            register = one.register
            parts = [write for write in writes if _touches(write, register)]
            if not parts:
                continue
            found = True
            if not one.address.table.writable:
                raise ValueError(f"nothing can be written to the table {one.address.table.value}")
            if register.bit is None and len(writes) == 1 and parts[0].mask:
                yield self._bit_of_word(one, parts[0])
            else:
                yield from self._values(one, parts)
        if not found:
            raise ValueError("no register of the tag table covers the written bytes")

    def _bit_of_word(self, one: _Register, write: Write) -> tuple[int, int, bytes]:
        """Return the request that writes one bit of an integer and no other bit (function 22)."""
        register, address = one.register, one.address
        options = self._options
        if register.scale is not None or address.kind is not register.element or address.kind.base == "STRING":
            raise ValueError("a bit of a converted value cannot be written; write the whole value")
        size = register.element.size
        element, byte = divmod(write.offset - register.offset, register.element.stride)
        byte = byte if self._layout.byte_order == "little" else size - 1 - byte  # 0: the lowest
        word, high = divmod(byte, 2)
        if (address.byte_order or options.byte_order) == "little":
            high = 1 - high if size > 1 else 1
        word = word if (address.word_order or options.word_order) == "little" else address.width - 1 - word
        bit = write.mask << 8 * high
        keep, put = 0xFFFF ^ bit, bit if write.data[0] & write.mask else 0
        start = address.number + element * address.width + word
        return one.unit, client.MASK_WORD, b"".join(number.to_bytes(2, "big") for number in (start, keep, put))

    def _values(self, one: _Register, writes: Sequence[Write]) -> Iterator[tuple[int, int, bytes]]:
        """Yield the requests that write the elements of a register which the writes together contain."""
        register, address = one.register, one.address
        image = bytearray(self._layout.size)
        covered = bytearray(self._layout.size)
        for write in writes:
            apply(write, image)
            apply(Write(write.offset, write.mask, b"\xff" * len(write.data)), covered)
        chosen = []
        for place, (at, size, bits) in enumerate(_places(register)):
            part = any(byte & bits for byte in covered[at : at + size])
            if part and any(byte & bits != bits for byte in covered[at : at + size]):
                raise ValueError("a part of a value cannot be written; write the whole value")
            if part:
                chosen.append(place)
        values = _flat(codec(register, self._layout.byte_order).decode(bytes(image)))
        if any(values[place] is None for place in chosen):
            raise ValueError(f"the bytes are not a valid {register.type}")
        for first, some in _runs(chosen, self._most(one)):
            yield from self._requests_of(
                one, address.number + first * address.width, [values[place] for place in range(first, first + some)]
            )

    def _most(self, one: _Register) -> int:
        """Return the maximum number of elements that one request may write."""
        if one.address.bit is not None or (one.codec is not None and one.codec.masks[-1] != _WORD):
            return 1  # the rest of a word may belong to other registers
        return MAX_WRITE_BITS if one.address.table.of_bits else max(1, MAX_WRITE_WORDS // one.address.width)

    def _requests_of(self, one: _Register, number: int, values: list[Any]) -> Iterator[tuple[int, int, bytes]]:
        """Yield the requests that write consecutive elements, starting at entry ``number`` of the table.

        There is one request, or two for a text of more than 246 characters.
        """
        address = one.address
        start = number.to_bytes(2, "big")
        if address.table is Table.COIL:
            if len(values) == 1:
                yield one.unit, client.WRITE_COIL, start + (b"\xff\0" if values[0] else b"\0\0")
                return
            packed = sum(bool(value) << bit for bit, value in enumerate(values)).to_bytes(
                -(-len(values) // 8), "little"
            )
            yield one.unit, client.WRITE_COILS, start + len(values).to_bytes(2, "big") + bytes((len(packed),)) + packed
            return
        if one.codec is None:
            bit = 1 << (address.bit or 0)
            masks = (_WORD ^ bit).to_bytes(2, "big") + (bit if values[0] else 0).to_bytes(2, "big")
            yield one.unit, client.MASK_WORD, start + masks
            return
        words, last = b"".join(map(one.codec.encode, values)), one.codec.masks[-1]
        whole = words if last == _WORD else words[:-2]
        for at in range(0, len(whole), 2 * MAX_WRITE_WORDS):
            part = whole[at : at + 2 * MAX_WRITE_WORDS]
            start = (number + at // 2).to_bytes(2, "big")
            if len(part) == 2:
                yield one.unit, client.WRITE_WORD, start + part
            else:
                count = (len(part) // 2).to_bytes(2, "big") + bytes((len(part),))
                yield one.unit, client.WRITE_WORDS, start + count + part
        if len(whole) < len(words):  # the rest of the last word may belong to another register
            start = (number + len(whole) // 2).to_bytes(2, "big")
            yield one.unit, client.MASK_WORD, start + (_WORD ^ last).to_bytes(2, "big") + words[-2:]


def _places(register: Register) -> Iterator[tuple[int, int, int]]:
    """Yield for each element its first byte, its size in bytes and the mask of its bits in each byte."""
    if register.type == "BOOL":
        for byte, bit in bit_positions(register):
            yield register.offset + byte, 1, 1 << bit
    else:
        for place in range(register.count):
            yield register.offset + place * register.element.stride, register.element.size, 0xFF


def _touches(write: Write, register: Register) -> bool:
    """Return whether a write contains bits of a register."""
    offset, mask, data = write
    if register.offset + register.size <= offset or register.offset >= offset + len(data):
        return False
    return register.bit is None or bool(register.dims) or not mask or mask == 1 << register.bit


def _cut(write: Write, register: Register) -> Iterator[int]:
    """Yield the offsets of the elements that a write contains only in part."""
    offset, mask, data = write
    stride, size = register.element.stride, register.element.size
    for byte in (offset, offset + len(data) - 1):  # the write contains all elements in between as a whole
        at = register.offset + max(0, byte - register.offset) // stride * stride
        if at < register.offset + register.size and (mask or at < offset or offset + len(data) < at + size):
            yield at


def _share(write: Write, at: int, size: int) -> bytes:
    """Return for each byte of an element a mask of the bits that a write contains."""
    offset, mask, data = write
    return bytes((mask or 0xFF) if offset <= place < offset + len(data) else 0 for place in range(at, at + size))


def _runs(places: Sequence[int], most: int) -> Iterator[tuple[int, int]]:
    """Yield (first, count) of each run of consecutive numbers, in pieces of at most ``most``."""
    at = 0
    while at < len(places):
        count = 1
        while at + count < len(places) and places[at + count] == places[at] + count and count < most:
            count += 1
        yield places[at], count
        at += count


def _flat(value: Value) -> list[Any]:
    return [inner for item in value for inner in _flat(item)] if isinstance(value, list) else [value]


def _nested(values: list[Any], shape: tuple[int, ...]) -> Value:
    """Return a flat list as nested lists of this shape."""
    for length in reversed(shape[1:]):
        values = [values[at : at + length] for at in range(0, len(values), length)]
    return values
