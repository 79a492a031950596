"""The connector ``opcua``: runs sessions in a thread, stores their values in an image, and writes values."""

from __future__ import annotations

import asyncio
import concurrent.futures
import importlib.util
import itertools
import logging
import math
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Coroutine, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple, TypeVar

import msgspec

from shmio.config.credentials import read_password
from shmio.connectors.base import Connector, Lost, WriteLostError
from shmio.connectors.browsing import Browsed, Wanted
from shmio.connectors.opcua.decode import Sample
from shmio.connectors.opcua.options import Credentials, OpcUaOptions
from shmio.connectors.opcua.structures import AbsentError, ChangedValue, find, read_value
from shmio.connectors.opcua.values import MismatchError, ValueConverter
from shmio.connectors.register_image import RegisterImage, no_status_area
from shmio.connectors.request_count import CycleRequests, Requests
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.addresses import siemens
from shmio.layout.addresses.opcua import Address, Member, parse_member
from shmio.layout.model import Layout, Register, bit_positions
from shmio.layout.values.codec import codec, flatten
from shmio.layout.values.write import Write, apply, bits_of
from shmio.model.statuses import (
    BAD_DECODING_ERROR,
    BAD_NO_DATA,
    BAD_NODE_ID_UNKNOWN,
    BAD_OUT_OF_RANGE,
    BAD_TYPE_MISMATCH,
    BAD_WAITING_FOR_INITIAL_DATA,
    describe,
    quality_of,
)
from shmio.model.values import Quality
from shmio.wording import counted

if TYPE_CHECKING:
    from shmio.connectors.opcua.session import Item, Session

EXTRA: Final = "connector: opcua needs another library; run pip install 'shmio[opcua]'"
CONNECT_TIMEOUTS: Final = 3
"""Maximum time for connecting, as a multiple of the time-out."""
CLOSE_S: Final = 0.5
MAX_REPORTED: Final = 20
"""Maximum number of faulty registers that the log names in each connection."""

_NO_DEADBAND: Final = "a member of a structure has no dead-band: the server sends each change of the structure"

_Result = TypeVar("_Result")

log = logging.getLogger("shmio.source")


class _Node(NamedTuple):
    """A node to read, with the indices of the registers that get its value or members of it."""

    address: Address
    is_structure: bool
    deadband: float
    """Dead-band in the numbers of the node, before scaling; 0 if there is none."""
    registers: list[int]


class _NodeWrite(NamedTuple):
    """A write to a node: a whole value, or the elements in an index range."""

    write: int
    """Index of the write that this node's write belongs to."""
    item: Item
    elements: str | None
    sample: Sample

    @property
    def writes(self) -> tuple[int, ...]:
        """The indices of the writes that this step belongs to."""
        return (self.write,)


class _MemberWrite(NamedTuple):
    """A new value for a register that is a member of a structure, or for some of its elements."""

    write: int
    """Index of the write that this belongs to."""
    register: int
    """Index of the register."""
    value: Any
    """The value; a flat list of the new elements if ``size`` is not 0."""
    first: int = 0
    size: int = 0
    """Number of new elements, from ``first`` on; 0 if the whole value is new."""

    def repeats(self, other: _MemberWrite) -> bool:
        """Return whether this write changes again what the other one has changed."""
        if self.register != other.register:
            return False
        apart = self.first + self.size <= other.first or other.first + other.size <= self.first
        return not (self.size and other.size and apart)


@dataclass
class _StructureWrite:
    """A write to members of one structure: the node is read, changed and written as a whole."""

    item: Item
    members: list[_MemberWrite]

    @property
    def writes(self) -> tuple[int, ...]:
        """The indices of the writes that this step belongs to."""
        return tuple(one.write for one in self.members)


@dataclass
class _Sending:
    """The writes of a cycle."""

    outcomes: list[str | Lost]
    deadline_ns: int
    """When to stop waiting for answers, ns of CLOCK_MONOTONIC."""
    steps: list[_NodeWrite | _StructureWrite] = field(default_factory=list)
    begun: int = 0
    """Number of the steps that may have been sent."""
    confirmed: int = 0
    """Number of the steps that have their answers."""
    future: concurrent.futures.Future[None] | None = None

    def lost(self, reason: str) -> WriteLostError:
        """Return the error for a lost connection, with what is known of the outcome of each write.

        A write that was sent but not answered is UNKNOWN: the server may have carried it out.
        """
        outcomes = [*self.outcomes]
        for number in (one for step in self.steps[self.confirmed : self.begun] for one in step.writes):
            if outcomes[number] == "":
                outcomes[number] = Lost.UNKNOWN
        done = {number for step in self.steps[: self.begun] for number in step.writes}
        for number in (one for step in self.steps[self.begun :] for one in step.writes):
            if outcomes[number] == "":
                outcomes[number] = Lost.UNKNOWN if number in done else Lost.UNSENT
        return WriteLostError(reason, outcomes)


class OpcUaConnector(Connector):
    """Reads the nodes of a layout's registers by subscription, or by polling, and writes to them."""

    Options = OpcUaOptions
    can_write = True
    register_quality = True
    reads_optimized = True
    register_options = frozenset({"nodes"})
    path_options: ClassVar[tuple[str, ...]] = (
        "certificate", "key", "trusted", "password_file", "user_certificate", "user_key",
    )  # fmt: skip

    def __init__(self, options: OpcUaOptions, layout: Layout) -> None:
        _need_library()
        if layout.optimized and options.nodes != "siemens":
            raise ConfigError(
                f'layout: the block {layout.name} has optimized access; set nodes = "siemens" to read it by names'
            )
        self._options, self._layout = options, layout
        self._nodes, self._members = _nodes(options, layout)
        self._node_of = {index: number for number, node in enumerate(self._nodes) for index in node.registers}
        self._converters = [ValueConverter(register) for register in layout.registers]
        self._credentials = _credentials(options)
        self._image = RegisterImage(layout) if layout.status_offset is not None else None
        self._lock = threading.Lock()  # guards the image and the latest samples
        self._latest: dict[int, Sample] = {}
        self._reported: set[tuple[int, str]] = set()
        self._link: _Link | None = None
        self._sending = _Sending([], 0)

    @classmethod
    def browse(cls, options: OpcUaOptions, wanted: Wanted) -> Browsed:
        """List the variables below the server's folder Objects, without those about the server itself."""
        _need_library()
        from shmio.connectors.opcua.browse import browse  # noqa: PLC0415  its library is optional

        logging.getLogger("asyncua").setLevel(logging.CRITICAL)
        return browse(msgspec.structs.replace(options, mode="poll"), _credentials(options), wanted)

    @property
    def timeout_s(self) -> float:
        """The longest time that any method may block, in s."""
        return CONNECT_TIMEOUTS * self._options.timeout / 1000

    @property
    def doubt(self) -> str:
        """Why values may have stopped changing although they can be read; empty if there is no such reason."""
        return self._link.doubt if self._link is not None else ""

    def describe(self) -> str:
        """Return, for the log, the peer and the mode of reading."""
        options = self._options
        how = f"{options.security}, {options.policy}" if options.security != "None" else "no security"
        sessions = self._link.sessions if self._link is not None else []
        subscribed = sum(session.subscriptions for session in sessions)
        mode = f"{subscribed} subscriptions" if options.mode == "subscribe" else "polling"
        return f"to {options.peer}, {len(self._nodes)} nodes, {mode}, sessions={len(sessions)}, {how}"

    def cycle_requests(self) -> CycleRequests:
        """Return the requests that a cycle sends; in mode ``subscribe``, a cycle sends none."""
        options, nodes = self._options, len(self._nodes)
        reads = counted(nodes, "node")
        if options.mode == "subscribe":
            return CycleRequests(
                reads, note=f"the server sends what has changed, at most every {options.publishing_ms} ms"
            )
        from shmio.connectors.opcua.session import MAX_PER_CALL  # noqa: PLC0415  a library that only sources need

        most = options.session_items
        count = sum(-(-min(most, nodes - at) // MAX_PER_CALL) for at in range(0, nodes, most))
        note = f"a server that takes fewer than {MAX_PER_CALL} nodes in a request gets more requests"
        return CycleRequests(reads, (Requests(count, count),), note)

    def connect(self) -> None:
        """Open the sessions, and wait for the first value of each node, but at most for the time-out.

        Raises:
            ConnectorError: The server cannot be reached, or refuses the client.

        """
        self.close()
        self._forget()
        link = self._link = _Link(self._options, self._credentials, self._nodes, self._deliver)
        link.start()
        try:
            link.opened.result(self.timeout_s)
        except concurrent.futures.TimeoutError:
            self.close()
            raise ConnectorError(f"no answer within {self.timeout_s * 1000:.0f} ms from {self._options.peer}") from None
        except ConnectorError:
            self.close()
            raise

    def take_over(self, other: OpcUaConnector) -> bool:
        """Take over the sessions of ``other``, and the newest values of the nodes that both connectors have."""
        link = other._link
        if link is None:
            return False
        self._link, other._link = link, None
        link.check()
        self._forget()
        link.call(lambda: link.change(self._nodes, self._deliver))
        return True

    def _forget(self) -> None:
        """Let all registers wait for their first values."""
        if self._image is None:
            raise no_status_area()
        with self._lock:
            self._latest.clear()
            for index in range(len(self._layout.registers)):
                self._image.fail(index, BAD_WAITING_FOR_INITIAL_DATA)
        self._reported.clear()

    def read(self) -> bytes:
        """Return the image of the newest values. In mode ``poll``, first read all nodes.

        Raises:
            ConnectorError: A session is lost, or its server has been silent for too long.

        """
        link, image = self._link, self._image
        if link is None or image is None:
            raise ConnectorError(f"not connected to {self._options.peer}")
        if self._options.mode == "poll":
            link.call(link.poll)
        link.check()
        with self._lock:
            return bytes(image)

    def close(self) -> None:
        """Close all sessions. You may call this at any time and more than once."""
        if self._link is not None:
            self._link.close()
            self._link = None

    # -- values --------------------------------------------------------------------------------------------------------

    def _deliver(self, samples: list[tuple[Item, Sample]]) -> None:
        """Store samples. The thread of the sessions calls this method."""
        assert self._image is not None  # noqa: S101 - for the type checker
        with self._lock:
            for item, sample in samples:
                self._store(self._image, item, sample)

    def _store(self, image: RegisterImage, item: Item, sample: Sample) -> None:
        node = self._nodes[item.index]
        item.code, item.seen, item.unread = sample.code, sample, False
        if quality_of(sample.code) is Quality.BAD or not sample.kind:
            code = sample.code or BAD_NO_DATA
            for index in node.registers:
                image.fail(index, code, sample.source_ns)
                if code & 0xFFFF0000 == BAD_NODE_ID_UNKNOWN:
                    self._report(index, f"the server reports {describe(code)}")
            return
        item.last = sample
        if not item.is_structure:
            (index,) = node.registers
            self._latest[index] = sample
            self._put(image, index, sample)
            return
        try:
            found = read_value(item.structures, sample)
        except AbsentError:
            for index in node.registers:
                image.fail(index, BAD_NO_DATA, sample.source_ns)
            return
        except MismatchError as error:
            item.unread = True
            for index in node.registers:
                image.fail(index, BAD_DECODING_ERROR, sample.source_ns)
            self._report(node.registers[0], f"{error}; list the node's members with shmio-supervisor browse")
            return
        for index in node.registers:
            try:
                member = find(found, self._members[index])
            except AbsentError:
                image.fail(index, BAD_NO_DATA, sample.source_ns)
            except MismatchError as error:
                image.fail(index, BAD_TYPE_MISMATCH, sample.source_ns)
                self._report(index, f"{error}; correct the register's address in the layout")
            else:
                code = member.code if quality_of(member.code) is Quality.BAD else sample.code
                source_ns = member.source_ns or sample.source_ns
                if quality_of(code) is Quality.BAD or not member.kind:
                    image.fail(index, code or BAD_NO_DATA, source_ns)
                else:
                    self._put(image, index, member._replace(code=code, source_ns=source_ns))

    def _put(self, image: RegisterImage, index: int, sample: Sample) -> None:
        try:
            fault = image.put(index, self._converters[index].value(sample), sample.source_ns, sample.code)
        except MismatchError as error:
            image.fail(index, BAD_TYPE_MISMATCH, sample.source_ns)
            self._report(index, f"{error}; correct the register's type in the layout")
            return
        except (ValueError, OverflowError) as error:
            image.fail(index, BAD_OUT_OF_RANGE, sample.source_ns)
            fault = str(error)
        if fault:
            self._report(index, f"the register cannot hold the server's value: {fault}")

    def _report(self, index: int, what: str) -> None:
        """Log a fault of a register, once per connection. After ``MAX_REPORTED`` faults, log no more of them."""
        if (index, what) in self._reported:
            return
        self._reported.add((index, what))
        if len(self._reported) <= MAX_REPORTED:
            log.warning("%s: %s", self._layout.registers[index].path, what)
        elif len(self._reported) == MAX_REPORTED + 1:
            log.warning("more registers are bad; use shmio get to see all of them")

    # -- writing -------------------------------------------------------------------------------------------------------

    def send(self, writes: Sequence[Write]) -> None:
        """Let the thread of the sessions write to the nodes; :meth:`confirm` waits for the outcomes.

        Raises:
            WriteLostError: A session is lost.

        """
        link = self._link
        if link is None or not link.ready:
            raise WriteLostError(f"not connected to {self._options.peer}", [Lost.UNSENT] * len(writes))
        sending = self._sending = _Sending([""] * len(writes), time.monotonic_ns() + round(self.timeout_s * 1e9))
        structures: dict[int, _StructureWrite] = {}
        for number, write in enumerate(writes):
            try:
                steps = list(self._steps(link, number, write))
            except ValueError as error:
                sending.outcomes[number] = str(error)
                continue
            for step in steps:
                if isinstance(step, _NodeWrite):
                    sending.steps.append(step)
                    continue
                item = link.items[self._node_of[step.register]]
                there = structures.get(item.index)
                if there is not None and not any(step.repeats(one) for one in there.members):
                    there.members.append(step)
                else:  # both values of a pulse are written
                    structures[item.index] = _StructureWrite(item, [step])
                    sending.steps.append(structures[item.index])
        try:
            sending.future = link.begin(lambda: self._carry_out(link, sending))
        except ConnectorError as error:
            raise sending.lost(str(error)) from None

    def confirm(self, until_ns: int) -> list[str] | None:
        """Wait until the nodes are written and read back, so that the next image has the new values.

        Raises:
            WriteLostError: A session was lost before the server had answered all writes.

        """
        link, sending = self._link, self._sending
        if link is None or sending.future is None:
            raise sending.lost(f"not connected to {self._options.peer}")
        try:
            link.result(sending.future, min(until_ns, sending.deadline_ns))
        except concurrent.futures.TimeoutError:
            if time.monotonic_ns() < sending.deadline_ns:
                return None
            sending.future.cancel()
            raise sending.lost(
                f"{self._options.peer} takes too long for the writes of a cycle; write fewer values at once"
            ) from None
        except ConnectorError as error:
            raise sending.lost(str(error)) from None
        return [str(outcome) for outcome in sending.outcomes]

    async def _carry_out(self, link: _Link, sending: _Sending) -> None:
        """Send the write requests, and read the nodes back. This runs in the thread of the sessions."""
        outcomes = sending.outcomes
        for step in sending.steps:
            if isinstance(step, _NodeWrite) and step.elements is not None and not await link.has_ranges(step):
                path = self._path(step)
                outcomes[step.write] = f"{path}: the server does not write single elements; write the whole array"
        sending.steps = [step for step in sending.steps if any(outcomes[number] == "" for number in step.writes)]
        for batch in _batches(sending.steps, link.per_write):
            if isinstance(batch, _StructureWrite):
                await self._write_structure(link, sending, batch)
                continue
            sending.begun += len(batch)
            codes = await link.write(batch)
            sending.confirmed += len(batch)
            for step, code in zip(batch, codes, strict=True):
                if quality_of(code) is Quality.BAD:
                    path = self._path(step)
                    outcomes[step.write] = f"{path}: the server refuses the write: {describe(code)}"
        if sending.steps:
            await link.read_back(list({step.item.index: step.item for step in sending.steps}.values()))

    async def _write_structure(self, link: _Link, sending: _Sending, step: _StructureWrite) -> None:
        """Read a structure, change members of it, and write it. A write that is impossible changes nothing."""
        outcomes, registers = sending.outcomes, self._layout.registers
        there = await link.present(step.item)
        refused = True
        while refused:  # a write of several members may be refused because of the last one
            members = [one for one in step.members if outcomes[one.write] == ""]
            changed: ChangedValue | None = None
            refused = False
            for one in members:
                try:
                    if quality_of(there.code) is Quality.BAD:
                        raise ValueError(f"the server reports {describe(there.code)}")
                    changed = changed or ChangedValue(step.item.structures, there)
                    self._change(changed, one)
                except ValueError as error:
                    outcomes[one.write] = outcomes[one.write] or f"{registers[one.register].path}: {error}"
                    refused = True
        sending.begun += 1
        if changed is not None and members:
            (code,) = await link.write([_NodeWrite(members[0].write, step.item, None, changed.sample)])
            if quality_of(code) is Quality.BAD:
                for one in members:
                    path = registers[one.register].path
                    outcomes[one.write] = f"{path}: the server refuses the structure: {describe(code)}"
        sending.confirmed += 1

    def _change(self, changed: ChangedValue, one: _MemberWrite) -> None:
        """Change a member of a structure. Raise ValueError if that is impossible."""
        member, converter = self._members[one.register], self._converters[one.register]
        now = changed.find(member)
        if not one.size:
            changed.set(member, converter.sample(one.value, now))
            return
        part = converter.elements(one.value, now)
        end = one.first + one.size
        if now.dims is None:
            raise ValueError("the server's value is not an array at present")
        if end > len(now.value):
            raise ValueError(f"the server's array has {len(now.value)} elements at present; the write needs {end}")
        values = [*now.value[: one.first], *part.value, *now.value[end:]]
        changed.set(member, now._replace(value=values))

    @staticmethod
    def _node_write(number: int, item: Item, elements: str | None, sample: Sample) -> _NodeWrite:
        """Return a write to a node. Raise ValueError if its value cannot be encoded."""
        from shmio.connectors.opcua.session import check_encoding  # noqa: PLC0415  a library that only sources need

        check_encoding(sample)
        return _NodeWrite(number, item, elements, sample)

    def _path(self, step: _NodeWrite) -> str:
        """Return the path of the register that a step writes."""
        return self._layout.registers[self._nodes[step.item.index].registers[0]].path

    def _steps(self, link: _Link, number: int, write: Write) -> Iterator[_NodeWrite | _MemberWrite]:
        """Yield the node writes that carry out a write of bytes. Raise ValueError if that is impossible."""
        layout, found = self._layout, False
        covered, image = bytearray(layout.size), bytearray(layout.size)
        apply(Write(write.offset, write.mask, b"\xff" * len(write.data)), covered)
        apply(write, image)
        for index in _overlapping(layout, write):
            register = layout.registers[index]
            wanted = bits_of(register)
            there = bytes(covered[register.offset : register.offset + register.size])
            share = bytes(a & b for a, b in zip(there, wanted, strict=True))
            if not any(share):
                continue
            found = True
            item = link.items[self._node_of[index]]
            if item.node is None:
                raise ValueError(f"{register.path}: the server does not know the node of this register")
            value = codec(register, layout.byte_order).decode(image)
            like, converter = self._latest.get(index), self._converters[index]
            try:
                if share == wanted:
                    if item.is_structure:
                        yield _MemberWrite(number, index, value)
                    else:
                        yield self._node_write(number, item, None, converter.sample(value, like))
                    continue
                elements = _elements(register, share)
                flat = list(flatten(value, register.shape, register.path))
                values = [flat[place] for place in elements]
                if item.is_structure:
                    first = _consecutive(elements)
                    yield _MemberWrite(number, index, values, first, len(values))
                    continue
                text, dims = _index_range(converter.shape(like), elements)
                sample = converter.elements(values, like)._replace(dims=dims)
                yield self._node_write(number, item, text, sample)
            except ValueError as error:
                raise ValueError(f"{register.path}: {error}") from None
        if not found:
            raise ValueError("no register of the layout covers the written bytes")


def _need_library() -> None:
    if importlib.util.find_spec("asyncua") is None:
        raise ConfigError(EXTRA)


def _nodes(options: OpcUaOptions, layout: Layout) -> tuple[list[_Node], list[Member]]:
    """Return the nodes of a layout, and for each register which member of its node's value it is.

    Registers that are members of the same structure share a node. Each other register has its own.

    Raises:
        ConfigError: An address is wrong.

    """
    nodes: list[_Node] = []
    members: list[Member] = []
    structures: dict[Address, _Node] = {}
    for index, register in enumerate(layout.registers):
        try:
            address, member = _address(options, layout, register)
            if member and register.deadband:
                raise ValueError(_NO_DEADBAND)
        except ValueError as error:
            raise ConfigError(f"layout: {register.path}: {error}") from None
        members.append(member)
        if member and address in structures:
            structures[address].registers.append(index)
            continue
        factor = 1.0 if register.scale is None else abs(register.scale[0])
        nodes.append(_Node(address, bool(member), register.deadband / factor, [index]))
        if member:
            structures[address] = nodes[-1]
    return nodes, members


def _address(options: OpcUaOptions, layout: Layout, register: Register) -> tuple[Address, Member]:
    """Return the address of a register's node, and which member of the node's value the register is.

    Raises:
        ValueError: The register's address is wrong.

    """
    if options.nodes == "siemens" and not register.address:
        return siemens.node_address(layout, register), ()
    return parse_member(register.address)


def _credentials(options: OpcUaOptions) -> Credentials:
    """Read the password and the certificates from their files. Raise ConfigError if a file cannot be used."""
    password = read_password(options.password_file, "password_file") if options.password_file else ""
    if options.certificate is None or options.key is None:
        return Credentials(password=password)
    from shmio.connectors.opcua import trust  # noqa: PLC0415  its library is not needed without security

    certificate, key = trust.read_identity(Path(options.certificate), Path(options.key))
    uri = trust.application_uri(certificate)
    if uri is None:
        raise ConfigError(
            f"certificate: {options.certificate}: this certificate has no application URI; add one to its "
            "subject alternative names, such as URI:urn:cell:shmio (OPC UA requires it)"
        )
    user = None
    if options.user_certificate is not None and options.user_key is not None:
        user = trust.read_user(Path(options.user_certificate), Path(options.user_key))
    return Credentials(uri, (certificate, key), password, user)


def _overlapping(layout: Layout, write: Write) -> range:
    """Return the indices of the registers that share a byte with a write."""
    registers, stop = layout.registers, write.offset + len(write.data)
    first = bisect_right(registers, write.offset, key=lambda register: register.offset + register.size)
    return range(first, bisect_left(registers, stop, key=lambda register: register.offset))


def _elements(register: Register, share: bytes) -> list[int]:
    """Return the places, in the flat array, of the elements whose bits are set in ``share``.

    Raises:
        ValueError: The bits are not those of whole elements.
    """
    if not register.dims:
        raise ValueError("OPC UA cannot write a part of a value; write the whole register")
    chosen: list[int] = []
    whole = True
    if register.type == "BOOL":
        chosen = [place for place, (at, bit) in enumerate(bit_positions(register)) if share[at] >> bit & 1]
    else:
        for place in range(register.count):
            start = place * register.element.stride
            part = share[start : start + register.element.size]
            if any(part):
                chosen.append(place)
                whole = whole and part == b"\xff" * len(part)
    if not whole or not chosen:
        raise ValueError("OPC UA cannot write a part of an element; write the whole element")
    return chosen


def _consecutive(elements: Sequence[int]) -> int:
    """Return the first of consecutive elements. Raise ValueError if there are others between them."""
    if elements[-1] - elements[0] + 1 != len(elements):
        raise ValueError("elements that do not follow each other cannot be written; write the whole array")
    return elements[0]


def _index_range(shape: Sequence[int], elements: Sequence[int]) -> tuple[str, tuple[int, ...]]:
    """Return the index range of elements of an array (OPC 10000-4, section 7.27), and its sizes.

    Raises:
        ValueError: They are not all elements of a range.

    """
    spans = [(min(places), max(places)) for places in zip(*(_place(shape, one) for one in elements), strict=True)]
    sizes = tuple(last - first + 1 for first, last in spans)
    if math.prod(sizes) != len(elements):
        raise ValueError("OPC UA writes elements that form a range alone; write the whole array")
    return ",".join(f"{first}:{last}" if last > first else f"{first}" for first, last in spans), sizes


def _place(shape: Sequence[int], element: int) -> tuple[int, ...]:
    """Return the indices, from 0, of an element whose place in the flat array is given."""
    indices = []
    for size in reversed(shape):
        element, index = divmod(element, size)
        indices.append(index)
    return (*reversed(indices),)


def _batches(steps: Sequence[_NodeWrite | _StructureWrite], most: int) -> Iterator[list[_NodeWrite] | _StructureWrite]:
    """Group steps into requests, in their order. A request is for one session, and writes no node twice."""
    batch: list[_NodeWrite] = []
    for step in steps:
        if isinstance(step, _StructureWrite):
            if batch:
                yield batch
            batch = []
            yield step
            continue
        full = len(batch) >= most or any(one.item is step.item for one in batch)
        if batch and (full or batch[0].item.session != step.item.session):
            yield batch
            batch = []
        batch.append(step)
    if batch:
        yield batch


class _Link(threading.Thread):
    """A thread that runs the sessions of one connection in its own event loop."""

    def __init__(
        self,
        options: OpcUaOptions,
        credentials: Credentials,
        nodes: Sequence[_Node],
        deliver: Callable[[list[tuple[Item, Sample]]], None],
    ) -> None:
        super().__init__(name="opcua", daemon=True)
        self._options, self._credentials, self._deliver = options, credentials, deliver
        self._nodes = nodes
        self._handles = itertools.count()
        self._loop = asyncio.new_event_loop()
        self._stopping = asyncio.Event()
        self._closed = False
        self._failure: ConnectorError | None = None
        self.opened: concurrent.futures.Future[None] = concurrent.futures.Future()
        self.sessions: list[Session] = []
        self.items: list[Item] = []

    # -- for the poll thread -------------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """True if all sessions are open, as far as the client knows."""
        return self._failure is None and bool(self.sessions) and all(one.ready for one in self.sessions)

    @property
    def per_write(self) -> int:
        """Maximum number of values that a request may write."""
        return min(one.per_write for one in self.sessions)

    @property
    def doubt(self) -> str:
        """Why values may stop changing; empty if there is no reason."""
        from shmio.connectors.opcua.session import STATES  # noqa: PLC0415

        for one in self.sessions:
            if one.state:
                name = STATES[one.state] if 0 <= one.state < len(STATES) else str(one.state)
                return f"the server's state is {name}: values may not change until it is Running"
        return ""

    def check(self) -> None:
        """Raise ConnectorError if a session is lost, or its server has been silent for too long."""
        if self._failure is not None:
            raise self._failure
        for one in self.sessions:
            if reason := one.check():
                self._failure = ConnectorError(reason)  # do not send CloseSession to a server that does not answer
                raise self._failure

    def call(self, work: Callable[[], Coroutine[Any, Any, _Result]]) -> _Result:
        """Run a coroutine in the loop, and wait for its result.

        Args:
            work: Creates the coroutine.

        Raises:
            ConnectorError: A session is lost, or the result does not come in time.

        """
        future = self.begin(work)
        limit_s = CONNECT_TIMEOUTS * self._options.timeout / 1000
        try:
            return self.result(future, time.monotonic_ns() + round(limit_s * 1e9))
        except concurrent.futures.TimeoutError:
            future.cancel()
            raise ConnectorError(f"no answer within {limit_s * 1000:.0f} ms from {self._options.peer}") from None

    def begin(self, work: Callable[[], Coroutine[Any, Any, _Result]]) -> concurrent.futures.Future[_Result]:
        """Start a coroutine in the loop; return a future, for :meth:`result`.

        Raises:
            ConnectorError: The session is lost.

        """
        if self._failure is not None:
            raise self._failure
        running = self._guarded(work)
        try:
            return asyncio.run_coroutine_threadsafe(running, self._loop)
        except RuntimeError:  # the loop has just ended
            running.close()
            raise self._failure or ConnectorError(f"the connection to {self._options.peer} was closed") from None

    def result(self, future: concurrent.futures.Future[_Result], until_ns: int) -> _Result:
        """Wait for the result of a coroutine.

        Args:
            future: The coroutine's future.
            until_ns: When to stop waiting, ns of CLOCK_MONOTONIC.

        Raises:
            TimeoutError: There is no result yet.
            ConnectorError: The session is lost.

        """
        try:
            return future.result(max(0.0, (until_ns - time.monotonic_ns()) / 1e9))
        except concurrent.futures.CancelledError:
            raise self._failure or ConnectorError(f"the connection to {self._options.peer} was closed") from None

    def close(self) -> None:
        """End the thread. If the sessions are alive, wait briefly until they have closed at the server."""
        self._closed = True
        healthy = self.ready
        with suppress(RuntimeError):  # the loop may have just ended
            self._loop.call_soon_threadsafe(self._stopping.set)
        if healthy:
            self.join(CLOSE_S)

    # -- in the loop ---------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Run the sessions until they are lost or the link is closed."""
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # this connector reports the errors itself
        try:
            self._loop.run_until_complete(self._main())
        except BaseException as error:  # noqa: BLE001  the poll thread reports it
            self._lose(ConnectorError(f"the connection failed: {type(error).__name__}: {error}"))
        finally:
            self._loop.close()

    async def _main(self) -> None:
        options = self._options
        self.items = [self._item(index, node) for index, node in enumerate(self._nodes)]
        sessions = self._new_sessions(self.items, 0)
        stopping = asyncio.create_task(self._stopping.wait())
        try:
            opening = asyncio.gather(*(one.open() for one in sessions))
            await asyncio.wait((opening, stopping), return_when=asyncio.FIRST_COMPLETED)
            if not opening.done():
                opening.cancel()
            await opening
            self.sessions = sessions
            self._watch(sessions)
            await self._first_values()
            if self._failure is None and not self.opened.done():
                self.opened.set_result(None)
            await stopping
        except ConnectorError as error:
            self._lose(error)
        except asyncio.CancelledError:
            self._lose(ConnectorError(f"the connection to {options.peer} was closed"))
        finally:
            stopping.cancel()
            healthy = self._failure is None
            opened = [*sessions, *(one for one in self.sessions if one not in sessions)]
            await asyncio.gather(*(one.close(polite=healthy) for one in opened), return_exceptions=True)
            rest = [one for one in asyncio.all_tasks() if one is not asyncio.current_task()]
            for task in rest:
                task.cancel()
            await asyncio.gather(*rest, return_exceptions=True)

    def _item(self, index: int, node: _Node) -> Item:
        from shmio.connectors.opcua.session import Item  # noqa: PLC0415  a library that only sources need

        return Item(index, next(self._handles), node.address, node.deadband, is_structure=node.is_structure)

    def _new_sessions(self, items: Sequence[Item], first: int) -> list[Session]:
        """Return new sessions for items; the first has the number ``first``. They are not open."""
        from shmio.connectors.opcua.session import Session  # noqa: PLC0415

        most = self._options.session_items
        sessions: list[Session] = []
        for at in range(0, len(items), most):
            part = items[at : at + most]
            for item in part:
                item.session = first + len(sessions)
            sessions.append(Session(self._options, self._credentials, part, self._deliver))
        return sessions

    def _watch(self, sessions: Iterable[Session]) -> None:
        """Notice when one of these sessions, which are open, is lost."""
        for one in sessions:
            one.failure.add_done_callback(self._session_lost)

    def _session_lost(self, failure: asyncio.Future[ConnectorError]) -> None:
        if not failure.cancelled():
            self._lose(failure.result())
            self._stopping.set()

    async def change(self, nodes: Sequence[_Node], deliver: Callable[[list[tuple[Item, Sample]]], None]) -> None:
        """Read other nodes, and deliver their samples to another object, which first gets the newest ones.

        Nodes that stay the same keep their monitored items and their sessions. A session without any
        nodes is closed, unless it is the only one. The definitions of structures are read again.
        """
        await asyncio.gather(*(one.learn_again() for one in self.sessions))
        left: dict[tuple[Any, ...], list[Item]] = {}
        for item in self.items:
            left.setdefault((item.address, item.deadband, item.is_structure), []).append(item)
        self._nodes, self._deliver = nodes, deliver
        kept: list[list[Item]] = [[] for _ in self.sessions]
        new: list[Item] = []
        items: list[Item] = []
        for index, node in enumerate(nodes):
            if same := left.get((node.address, node.deadband, node.is_structure)):
                item = same.pop()
                item.index = index
                kept[item.session].append(item)
            else:
                item = self._item(index, node)
                new.append(item)
            items.append(item)
        parts: list[list[Item]] = []
        at = 0
        for number, own in enumerate(kept):
            room = max(0, self._options.session_items - len(own))
            parts.append(new[at : at + room])
            for item in parts[-1]:
                item.session = number
            at += len(parts[-1])
        gone = [one.switch(own, part, deliver) for one, own, part in zip(self.sessions, kept, parts, strict=True)]
        self.items = items
        for item in (item for own in kept for item in own):
            seen = [item.seen] if item.last is item.seen else [item.last, item.seen]
            deliver([(item, sample) for sample in seen if sample is not None])
        present = self.sessions
        more = self._new_sessions(new[at:], len(present))
        self.sessions = [*present, *more]
        await asyncio.gather(
            *(one.follow(those, part) for one, those, part in zip(present, gone, parts, strict=True)),
            *(one.open() for one in more),
        )
        self._watch(more)
        await self._close_empty()

    async def _close_empty(self) -> None:
        """Close the sessions without nodes, but not the last session."""
        empty = [one for one in self.sessions if not one.items]
        if len(empty) == len(self.sessions):
            empty = empty[1:]
        self.sessions = [one for one in self.sessions if one not in empty]
        for number, one in enumerate(self.sessions):
            for item in one.items:
                item.session = number
        await asyncio.gather(*(one.close(polite=True) for one in empty))

    async def _first_values(self) -> None:
        """Read all nodes in mode ``poll``; else wait, at most for the time-out, for their first values."""
        if self._options.mode == "poll":
            await self._guarded(self.poll)
            return
        end_s = self._loop.time() + self._options.timeout / 1000
        while any(one.waiting for one in self.sessions) and self._loop.time() < end_s:
            if self._stopping.is_set():
                return
            await asyncio.sleep(0.005)

    def _lose(self, error: ConnectorError) -> None:
        self._failure = self._failure or error
        if not self.opened.done():
            self.opened.set_exception(error)

    async def _guarded(self, work: Callable[[], Coroutine[Any, Any, _Result]]) -> _Result:
        try:
            return await work()
        except Exception as error:
            if isinstance(error, ConnectorError) and not self.sessions:
                raise
            raise self.sessions[0].explained(error) from None

    async def poll(self) -> None:
        """Read all nodes of all sessions."""
        await asyncio.gather(*(one.poll() for one in self.sessions))

    async def write(self, batch: Sequence[_NodeWrite]) -> list[int]:
        """Write a batch whose nodes belong to one session; return the status codes."""
        session = self.sessions[batch[0].item.session]
        return await session.write([(step.item, step.elements, step.sample) for step in batch])

    async def present(self, item: Item) -> Sample:
        """Read the present value of a node."""
        return await self.sessions[item.session].present(item)

    async def has_ranges(self, step: _NodeWrite) -> bool:
        """Return whether the server supports the index range of a write."""
        assert step.elements is not None  # noqa: S101 - for the type checker
        return await self.sessions[step.item.session].has_ranges(step.item, step.elements, step.sample.dims)

    async def read_back(self, items: Sequence[Item]) -> None:
        """Read nodes that were just written."""
        for number, session in enumerate(self.sessions):
            if own := [item for item in items if item.session == number]:
                await session.read_back(own)
