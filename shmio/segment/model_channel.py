"""The channel between a source and its remote model: requests for steps, and their answers.

docs/reference/segment-format.md describes the channel's section. The source's process writes the
requests. The process to which the model is connected locks the channel as long as the connection
lasts, and writes the model's name and answers.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from shmio.errors import ConfigError, PathError
from shmio.layout.glob import select
from shmio.layout.model import Layout, Register
from shmio.layout.topic import near
from shmio.model.values import Provenance, Quality
from shmio.segment import _atomics
from shmio.segment.header import cut, text
from shmio.segment.shm import SharedObject
from shmio.wording import did_you_mean

SLOTS: Final = 4
MAX_NAME_BYTES: Final = 103

_SIZE: Final = struct.Struct("<Q")
_JOINED_AT: Final = 64
_JOINED: Final = struct.Struct("<IIQ104s")
_RINGS_AT: Final = 192
_COMPUTED: Final = 1  # flag: a model has done a step


class ModelPorts(NamedTuple):
    """Inputs and outputs of a remote model. A register that the model both reads and computes is in both."""

    inputs: tuple[Register, ...]
    """Registers that the model reads."""
    outputs: tuple[Register, ...]
    """Registers that the model computes."""


class ConnectedModel(NamedTuple):
    """A remote model that is connected to a source.

    ``number`` is the number of the connection, from 1. ``pid`` is the process that writes the
    model's answers.
    """

    number: int
    pid: int
    name: str


class ModelRequest(NamedTuple):
    """A source's request to a model to compute one step.

    Attributes:
        number: Number of the request; the same step may be requested again.
        step: Number of the step.
        time_ns: The instance's clock after the step, in ns.
        dt_ns: Length of the step, in ns.
        until_ns: Time at which the source stops waiting for the answer, CLOCK_MONOTONIC in ns.
        doubt: Reason why the model's inputs may be wrong; empty: there is none.
        commanded: The block's image with the values that the model reads.
        shown: The block's image with the present values of the model's outputs.
    """

    number: int
    step: int
    time_ns: int
    dt_ns: int
    until_ns: int
    doubt: str
    commanded: bytes
    shown: bytes


class ModelAnswer(NamedTuple):
    """A model's answer to a request.

    ``image`` is the block's image with the computed outputs. ``failure`` is None, or the reason why
    the step failed; in that case, ``image`` is not used.
    """

    image: bytes
    failure: str | None


def model_ports(layout: Layout, outputs: Sequence[str], inouts: Sequence[str]) -> ModelPorts:
    """Find a model's inputs and outputs.

    Registers of tag tables over the block have no values of their own, so they are neither.

    Args:
        layout: The layout of the block.
        outputs: Patterns of the registers that the model computes and does not read. All other
            registers are inputs.
        inouts: Patterns of the registers that the model both reads and computes.

    Raises:
        ConfigError: A pattern matches no register, or a register matches both ``outputs`` and
            ``inouts``. The message starts with the key.
    """
    layout = layout.base
    computed, both = (_named(layout, *item) for item in (("outputs", outputs), ("inouts", inouts)))
    if twice := sorted(computed & both):
        path = layout.registers[twice[0]].path
        raise ConfigError(f"inouts: {path} is in outputs, too; name an in-out register only in inouts")
    registers = list(enumerate(layout.registers))
    return ModelPorts(
        tuple(register for index, register in registers if index not in computed),
        tuple(register for index, register in registers if index in computed | both),
    )


def _named(layout: Layout, key: str, patterns: Sequence[str]) -> set[int]:
    found: set[int] = set()
    for pattern in patterns:
        try:
            some = select(layout, [pattern])
        except PathError as error:
            raise ConfigError(f"{key}: {error}") from None
        if not some:
            alike = [] if "*" in pattern else [path for path in near(layout, pattern) if path != pattern]
            what = f"{key}: {pattern!r} matches no register of {layout.name}; only whole registers are allowed"
            raise ConfigError(f"{what}; {did_you_mean(alike)}" if alike else what)
        found.update(some)
    return found


def section(ring_header: bytes, slot_bytes: int) -> tuple[int, bytes]:
    """Return the size and the first bytes of a new section.

    Args:
        ring_header: The first bytes of each of its two rings.
        slot_bytes: Size of a slot of the rings, in bytes.
    """
    ring_size = _atomics.RING_HEADER_SIZE + SLOTS * slot_bytes
    begin = _SIZE.pack(ring_size).ljust(_RINGS_AT, b"\0") + ring_header.ljust(ring_size, b"\0") + ring_header
    return _RINGS_AT + 2 * ring_size, begin


class ModelChannel:
    """The channel between one block's source and its remote model."""

    def __init__(self, shared: SharedObject, memory: memoryview, offset: int, size: int, lock_byte: int) -> None:
        """Open the section; raise ValueError if its sizes and offsets are inconsistent."""
        (ring_size,) = _SIZE.unpack_from(memory, offset) if size >= _RINGS_AT else (0,)
        if not 0 < ring_size <= (size - _RINGS_AT) // 2:
            raise ValueError("the model channel's rings do not fit in its section")
        self._shared = shared
        self._memory = memory
        self._offset = offset
        self._lock_byte = lock_byte
        first = offset + _RINGS_AT
        self.asked = _atomics.Ring(memory, first, ring_size)
        self.answered = _atomics.Ring(memory, first + ring_size, ring_size)
        if self.asked.frame_size != self.answered.frame_size:
            raise ValueError("the model channel's rings for requests and answers differ in the size of a frame")

    @property
    def frame_size(self) -> int:
        """Size of an image in bytes."""
        return self.asked.frame_size

    def model(self) -> ConnectedModel | None:
        """Return the connected model; None if there is none, or if the process that serves it has died."""
        return self._read() if self._shared.locked(self._lock_byte) else None

    def _read(self) -> ConnectedModel:
        data = _atomics.cell_read(self._memory, self._offset + _JOINED_AT, _JOINED.size)
        if data is None:
            return ConnectedModel(0, 0, "")
        pid, _, number, name = _JOINED.unpack(data)
        return ConnectedModel(number, pid, text(name))

    def computed(self) -> bool:
        """Return whether the connected model, or a model before it, has computed a step."""
        data = _atomics.cell_read(self._memory, self._offset + _JOINED_AT, _JOINED.size)
        return data is not None and _JOINED.unpack(data)[1] == _COMPUTED

    # ---- for the source's process --------------------------------------------------------------------------------

    def ask(self, ask: ModelRequest, publish_ns: int) -> int:
        """Send a request to the model, and return the request's number.

        ``publish_ns`` is the publish time of the frame that the source will publish for the step.
        """
        return self.asked.publish(
            ask.commanded, ask.shown, ask.step, publish_ns, ask.time_ns, ask.until_ns,
            Quality.UNCERTAIN if ask.doubt else Quality.GOOD, Provenance.SIMULATED, ask.dt_ns, 0,
            cut(ask.doubt, _atomics.REASON_SIZE),
        )  # fmt: skip

    def answer_to(self, number: int) -> ModelAnswer | None:
        """Return the model's newest answer if it belongs to the request with this number, else None.

        So an answer that comes too late is never used.
        """
        fields = self.answered.latest()
        if fields is None or fields[8] != number:
            return None
        failed = fields[6] != Quality.GOOD
        return ModelAnswer(fields[11], fields[10] if failed else None)

    # ---- for the process that writes the model's answers -----------------------------------------------------------

    def join(self, name: str) -> bool:
        """Lock the channel for a model with this name; return False if another process has locked it."""
        if not self._shared.try_lock(self._lock_byte):
            return False
        self._write(ConnectedModel(self._read().number + 1, os.getpid(), name), _COMPUTED if self.computed() else 0)
        self.answered.begin()
        return True

    def _write(self, joined: ConnectedModel, flags: int) -> None:
        data = _JOINED.pack(joined.pid, flags, joined.number, cut(joined.name, MAX_NAME_BYTES))
        _atomics.cell_write(self._memory, self._offset + _JOINED_AT, data)

    def leave(self) -> None:
        """Unlock the channel, and wake a source that waits for an answer."""
        self._shared.unlock(self._lock_byte)
        self.answered.wake()

    def newest(self) -> ModelRequest | None:
        """Return the last request; None if there was none."""
        fields = self.asked.latest()
        if fields is None:
            return None
        number, step, _, time_ns, until_ns, _, _, _, dt_ns, _, doubt, commanded, shown = fields
        return ModelRequest(
            number, step, time_ns, dt_ns, until_ns, doubt, commanded, commanded if shown is None else shown
        )

    def answer(self, ask: ModelRequest, now_ns: int, image: bytes | bytearray, failure: str | None = None) -> None:
        """Answer a request.

        Args:
            ask: The request.
            now_ns: The present time, CLOCK_MONOTONIC.
            image: The block's image with the computed outputs.
            failure: Reason why the step failed; None: the step succeeded.
        """
        if failure is None and not self.computed():
            self._write(self._read(), _COMPUTED)
        self.answered.publish(
            image, None, ask.step, now_ns, ask.time_ns, 0, Quality.GOOD if failure is None else Quality.BAD,
            Provenance.SIMULATED, ask.number, 0, cut(failure or "", _atomics.REASON_SIZE),
        )  # fmt: skip
