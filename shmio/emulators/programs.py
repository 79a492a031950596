"""The programs that an emulated controller can run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from shmio.errors import ConfigError, ModelError, SnapshotError
from shmio.layout.model import NUMBERS, Layout
from shmio.layout.values.codec import Value, codec
from shmio.model.snapshot import decode_part
from shmio.wording import unknown

# numpy and the models are imported where they are used: most emulators need neither, and start faster without.
if TYPE_CHECKING:
    import numpy as np


class Stateless:
    """Base class of programs whose registers depend only on the time and the memory."""

    def save(self) -> bytes:
        """Return an empty state."""
        return b""

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check that a state is empty; there is nothing to restore.

        Raises:
            SnapshotError: The state is not empty, so it is that of another program.

        """
        if data:
            raise SnapshotError("the snapshot is of another program")
        return lambda: None


class A50:
    """The program of the A50 cell's controller, with a model of the plant."""

    period_ms = 10

    def __init__(self, layout: Layout) -> None:
        """Find the registers. Raise ConfigError if one is missing or has another type."""
        from shmio.simulation import ModelRunner  # noqa: PLC0415
        from shmio.simulation.a50 import A50Cell  # noqa: PLC0415

        # A DB201 that was copied from a printout has spaces instead of some underscores.
        named = tuple(
            msgspec.structs.replace(register, path=register.path.replace(" ", "_")) for register in layout.registers
        )
        try:
            self._runner = ModelRunner(A50Cell, replace(layout, registers=named))
        except ConfigError as error:
            raise ConfigError(f"program a50: {str(error).removeprefix('layout: ')}") from None

    def step(self, time_s: float, frame: bytearray) -> None:
        """Write the axes, inputs and outputs at ``time_s`` into the frame."""
        self._runner.resume(bytes(frame))  # clients may have written any register, also outputs
        frame[:] = self._runner.step(round(time_s * 1e9), self.period_ms * 1_000_000)

    def save(self) -> bytes:
        """Return the model's state."""
        return self._runner.save()

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check a state, and return the function that restores it."""
        return self._runner.prepare_restore(data)


# Word i of generation g is g + i * STRIDE modulo 2**64. STRIDE is odd, so that all words of a block
# differ; and for longer than any test runs, no word occurs at its place again.
_STRIDE = 0x9E37_79B9_7F4A_7C15


class Counter(Stateless):
    """Fills the block with big-endian 64-bit words, computed from the cycle number and the word's place.

    If fewer than eight bytes remain at the end, they contain the first bytes of a word.
    """

    period_ms = 1

    def __init__(self, layout: Layout) -> None:
        self._size = layout.size
        self._places = _places(layout.size)

    def step(self, time_s: float, frame: bytearray) -> None:
        """Fill the frame with the words of the cycle at ``time_s``."""
        import numpy as np  # noqa: PLC0415

        generation = np.uint64(round(time_s * 1000 / self.period_ms))
        frame[:] = (self._places + generation).astype(">u8").tobytes()[: self._size]


def generations(frame: bytes | bytearray | memoryview) -> list[int]:
    """Return the distinct cycle numbers in a frame of a ``Counter``, ascending.

    A frame from a single cycle gives one number. A wrong byte gives a number far from the others.
    """
    import numpy as np  # noqa: PLC0415

    size = len(frame)
    whole = size // 8 * 8
    places = _places(size)
    words = np.frombuffer(frame, ">u8", count=whole // 8).astype(np.uint64) - places[: whole // 8]
    found = {int(word) for word in np.unique(words)}
    rest = bytes(frame[whole:])
    if rest and not any(_word(g, whole // 8)[: len(rest)] == rest for g in found):
        found.add(int.from_bytes(rest.ljust(8, b"\0"), "big"))
    return sorted(found)


def _places(size: int) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    import numpy as np  # noqa: PLC0415

    return np.arange((size + 7) // 8, dtype=np.uint64) * np.uint64(_STRIDE)


def _word(generation: int, place: int) -> bytes:
    return ((generation + place * _STRIDE) & 0xFFFF_FFFF_FFFF_FFFF).to_bytes(8, "big")


class Wave(Stateless):
    """Moves all registers that commands cannot write: numbers swing from 0 to 100, and bits blink.

    Each register has its own phase. The program does not change texts, times, or registers that a tag
    table makes writable.
    """

    period_ms = 50
    swing_s = 10.0

    def __init__(self, layout: Layout) -> None:
        """Find the registers to move. Raise ConfigError if there are none."""
        moved = [one for one in layout.registers if not one.writable and (one.type in NUMBERS or one.type == "BOOL")]
        if not moved:
            raise ConfigError(
                "program wave: there is nothing to move: the layout has no number or BOOL that is not writable"
            )
        self._moved = [(codec(one, layout.byte_order), one.shape, one.type) for one in moved]

    def step(self, time_s: float, frame: bytearray) -> None:
        """Write the values at ``time_s`` into the frame."""
        for place, (own, shape, kind) in enumerate(self._moved):
            level = 50 - 50 * math.cos(2 * math.pi * (time_s / self.swing_s + place / 16))
            value: Value = level > 50 if kind == "BOOL" else level if kind in ("REAL", "LREAL") else round(level)
            for length in reversed(shape):
                value = [value] * length
            own.encode_into(value, frame)


class Idle(Stateless):
    """Changes no register: a controller in RUN without a user program."""

    period_ms = 100
    """Time between two cycles, in ms; the cycles only show that the controller works."""

    def __init__(self, layout: Layout) -> None:
        """Accept any layout."""

    def step(self, time_s: float, frame: bytearray) -> None:
        """Change nothing."""


@dataclass(frozen=True)
class UserCode:
    """The folder and the parameters of a program that is a class of the user."""

    folder: str | None = None
    """Folder of modules that are not installed; None: all modules are installed."""
    parameters: Mapping[str, Any] = field(default_factory=dict)


BUILT_IN: Final = UserCode()


class UserProgram:
    """Runs a class of the user: a ``shmio.plc.Program``, or any other model."""

    def __init__(self, name: str, layout: Layout, code: UserCode) -> None:
        """Import the class, and find its registers.

        Raises:
            ConfigError: There is no such class, or the layout or the parameters do not suit it.

        """
        from shmio.simulation import ModelRunner  # noqa: PLC0415
        from shmio.simulation.loading import load  # noqa: PLC0415

        try:
            model = load(name, code.folder)
        except (ConfigError, ModelError) as error:
            raise ConfigError(f"program: {error}") from None
        self._runner = ModelRunner(model, layout, code.parameters)
        self.period_ms: float = getattr(model, "period_ms", MODEL_PERIOD_MS)
        self._time_ns = 0

    def step(self, time_s: float, frame: bytearray) -> None:
        """Run a scan on the frame. Raise ModelError if the user's code fails."""
        time_ns = round(time_s * 1e9)
        self._runner.resume(bytes(frame))  # clients may have written any register, also outputs
        frame[:] = self._runner.step(time_ns, time_ns - self._time_ns)
        self._time_ns = time_ns

    def save(self) -> bytes:
        """Return the time of the last scan, and the state of the user's program."""
        return msgspec.msgpack.encode((self._time_ns, self._runner.save()))

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check a state, and return the function that restores it."""
        time_ns, own = decode_part(data, tuple[int, bytes], "the state of the program")
        restore_own = self._runner.prepare_restore(own)

        def restore() -> None:
            restore_own()
            self._time_ns = time_ns

        return restore


class Program(Protocol):
    """A controller's user program, with the plant it controls."""

    @property
    def period_ms(self) -> float:
        """Time between two cycles, in ms."""

    def step(self, time_s: float, frame: bytearray) -> None:
        """Run the cycle at ``time_s`` after the program's start, and change the block in place.

        Registers that the program does not set keep what clients wrote; the program may read them.
        ``frame`` keeps its length.
        """

    def save(self) -> bytes:
        """Return the program's state for a snapshot. The memory is saved separately.

        Raises:
            SnapshotError: The program cannot save its state.
            ModelError: The program's code failed.

        """

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check a state, and return the function that restores it.

        Raises:
            SnapshotError: The state is damaged, or is that of another program.

        """


MODEL_PERIOD_MS: Final = 10.0
"""Time between two cycles of a model that is not a ``shmio.plc.Program``, in ms."""
IDLE = "idle"
PROGRAMS: Mapping[str, Callable[[Layout], Program]] = {"a50": A50, "counter": Counter, IDLE: Idle, "wave": Wave}


def is_user_code(name: str) -> bool:
    """Return whether a program is a class of the user, ``package.module:Class``."""
    return ":" in name


def program(name: str, layout: Layout, code: UserCode = BUILT_IN) -> Program:
    """Create the program called ``name`` for a block with this layout.

    Raises:
        ConfigError: There is no such program, or the layout lacks a register.

    """
    if is_user_code(name):
        return UserProgram(name, layout, code)
    try:
        build = PROGRAMS[name]
    except KeyError:
        raise ConfigError(
            f"program: {unknown('program', name, sorted(PROGRAMS))} (the name of a class of your own is "
            "package.module:Class)"
        ) from None
    return build(layout)
