"""A model as its program serves it: what comes down and what goes up, without the way it goes."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from shmio.client import calls
from shmio.client.table import FIELDS, Array, Register, Table
from shmio.errors import ConflictError, LostError, PathError, RemoteError, ShmioError, ValueRangeError
from shmio.model.values import Column
from shmio.wire import shmio_v1_pb2 as wire

RETRY_S: Final = 0.25
"""Time between two attempts to join."""
PATIENCE_S: Final = 10.0
"""So long an instance that is not there is waited for."""
_WHOLE: Final = frozenset({Column.INT32, Column.INT64, Column.UINT64})
_FAILURE_CHARACTERS: Final = 400

log = logging.getLogger("shmio.client")


class Values(Mapping[str, Any]):
    """Values by the paths of their registers, without the source: scalars and arrays of numpy, texts.

    None: the bytes are no value of the type. The next step changes them.
    """

    def __init__(self, table: Table) -> None:
        self._table = table
        self.changed: tuple[str, ...] = ()
        """Paths of what came with the present step: all with the first one."""

    def __getitem__(self, path: str) -> Any:
        """A register's value; PathError."""
        return self._table.value(self._table.place(path))

    def __contains__(self, path: object) -> bool:
        return path in self._table.places

    def __iter__(self) -> Iterator[str]:
        return iter(self._table.places)

    def __len__(self) -> int:
        return len(self._table.registers)


class Work:
    """A step to be done. ``time_s``: simulation time after it; ``dt_s``: by how much it moves that.

    ``doubt``: why inputs may not be right; ``refused``: why the answer before counts for nothing; else both are empty.
    """

    __slots__ = ("doubt", "dt_ns", "inputs", "refused", "step", "time_ns")

    def __init__(self, found: Any, inputs: Values) -> None:
        self.step: int = found.step
        self.time_ns: int = found.time_ns
        self.dt_ns: int = found.dt_ns
        self.doubt: str = found.doubt
        self.refused: str = found.refused
        self.inputs = inputs

    @property
    def time_s(self) -> float:
        """In seconds."""
        return self.time_ns / 1e9

    @property
    def dt_s(self) -> float:
        """In seconds."""
        return self.dt_ns / 1e9


class Part:
    """What is known of a source that a program computes."""

    def __init__(self, found: Any) -> None:
        """``found``: the first answer, None if there was none. RemoteError: it is none."""
        if found is None or found.WhichOneof("what") != "joined":
            raise RemoteError("the endpoint's first answer to Simulate is none")
        joined = found.joined
        self._inputs = Table(joined.inputs)
        self._outputs = Table(joined.outputs)
        self._outputs.apply(joined.values)
        self.source: str = self._inputs.source
        self.inputs = Values(self._inputs)
        self.outputs = Values(self._outputs)
        self.computed: bool = joined.computed
        self.clock = calls.clock(joined.clock)
        self.period_s: float = joined.period_ns / 1e9

    def take(self, found: Any) -> Work:
        """What an answer asks for. RemoteError: it makes no sense."""
        if found.WhichOneof("what") != "work":
            raise RemoteError("the endpoint asks for no step")
        work = found.work
        changes = self._inputs.apply(work.values) if work.HasField("values") else ()
        if work.HasField("invalid"):
            self._inputs.mark(work.invalid, self._inputs.invalid)
        registers = self._inputs.registers
        self.inputs.changed = tuple(registers[place].path for place in self._inputs.changed(changes))
        return Work(work, self.inputs)

    def done(self, step: int, outputs: Mapping[str, object]) -> bytes:
        """The answer with these outputs. PathError: there is no such one; ValueRangeError: a value does not fit."""
        columns: dict[Column, tuple[list[int], list[Any]]] = {}
        for path, value in outputs.items():
            register = self._outputs.registers[self._place(path)]
            slots, values = columns.setdefault(register.column, ([], []))
            slots.extend(range(register.slot, register.slot + register.count))
            values.extend(_flat(value, register))
        try:
            return _answer(step, columns)
        except (TypeError, ValueError, OverflowError):
            for path, value in outputs.items():
                _check(value, self._outputs.registers[self._place(path)])
            raise

    def _place(self, path: str) -> int:
        try:
            return self._outputs.place(path)
        except PathError:
            there = ", ".join(self.outputs)
            raise PathError(f"{path}: it is no output of {self.source}; there are: {_shorten(there)}") from None

    @staticmethod
    def failed(step: int, reason: str) -> bytes:
        """The answer that it has failed."""
        return wire.SimulateRequest(done=wire.Done(step=step, failure=_shorten(reason))).SerializeToString()


class Member:
    """What both kinds of clients give of a source that they have joined.

    ``inputs``: what is given, by path; ``outputs``: what was shown when it joined; ``computed``: whether a model has
    computed that, or it is initial values. ``clock``: how time stood then; ``period_s``: between two steps as long as
    time is real.
    """

    def __init__(self, part: Part) -> None:
        self._part = part
        self._work: Work | None = None
        self.source = part.source
        self.inputs = part.inputs
        self.outputs = part.outputs
        self.computed = part.computed
        self.clock = part.clock
        self.period_s = part.period_s

    def _present(self) -> int:
        """The step that is to be answered. RemoteError: none is."""
        if self._work is None:
            raise RemoteError(f"{self.source}: no step is to be answered")
        return self._work.step


def join(source: str, name: str) -> bytes:
    """The first message."""
    return wire.SimulateRequest(join=wire.Join(source=source, name=name)).SerializeToString()


class Rejoining:
    """Whether who computes a source is to join once more, and what it has to say then."""

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._lost_s: float | None = time.monotonic()
        self._joined = False
        self._known: dict[str, object] = {}  # the outputs as they were given last
        self._told = True  # whether the present endpoint knows them all
        self._failure = ""

    def joined(self) -> None:
        """It has."""
        self._lost_s, self._told, self._joined = None, not self._joined, True

    def patient(self, error: ShmioError) -> bool:
        """Whether it is to be tried again."""
        if self._lost_s is None:
            self._lost_s = time.monotonic()
        # Who was cut off is for a while still taken for connected.
        again = isinstance(error, LostError) or (self._joined and isinstance(error, ConflictError))
        return again and time.monotonic() - self._lost_s < self._patience_s

    def heed(self, part: Part, work: Work) -> None:
        """The log tells what the endpoint says of the answer before."""
        if work.refused:
            log.warning("%s: %s", part.source, work.refused)

    def answer(self, part: Part, work: Work, outputs: Mapping[str, object] | None) -> bytes:
        """The answer with what was computed; after another joining with all that was before. Errors as of ``done``."""
        outputs = {} if outputs is None else outputs
        if not isinstance(outputs, Mapping):
            raise ValueRangeError(f"step gave {_shorten(repr(outputs))}, and is to give outputs by their paths")
        answer = part.done(work.step, outputs if self._told else {**self._known, **outputs})
        self._known.update(outputs)
        self._told, self._failure = True, ""
        return answer

    def failed(self, part: Part, work: Work, error: Exception) -> bytes:
        """The answer that a step has failed. The log tells each reason once."""
        text = explain(error)
        if text != self._failure:
            self._failure = text
            log.warning("%s: step %d failed: %s", part.source, work.step, text)
            log.debug("%s: step %d", part.source, work.step, exc_info=error)
        return part.failed(work.step, text)


def explain(error: Exception) -> str:
    """What a program's code has raised, and at which line, in one line."""
    if isinstance(error, ShmioError):
        return _shorten(" ".join(str(error).split()))
    where = ""
    if frames := traceback.extract_tb(error.__traceback__):
        where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})"
    return _shorten(" ".join(f"{type(error).__name__}: {error}".split())) + where


def _answer(step: int, columns: Mapping[Column, tuple[list[int], list[Any]]]) -> bytes:
    request = wire.SimulateRequest()
    done = request.done
    done.step = step
    done.values.SetInParent()
    for column, (slots, values) in columns.items():
        part = getattr(done.values, FIELDS[column])
        part.slots.extend(slots)
        part.values.extend(values)
    return request.SerializeToString()


def _check(value: object, register: Register) -> None:
    """ValueRangeError: protobuf does not take a value for its column."""
    try:
        _answer(0, {register.column: ([], list(_flat(value, register)))})
    except (TypeError, ValueError, OverflowError):
        raise ValueRangeError(f"{register.path}: expected {register.type}, found {_shorten(repr(value))}") from None


def _flat(value: object, register: Register) -> Iterable[object]:
    """The elements of a value as its column has them. ValueRangeError: it has another shape."""
    if not register.dims:
        return (_element(value, register.column),)
    array: Array = np.frombuffer(value, np.uint8) if isinstance(value, (bytes, bytearray)) else _array(value)
    if array.shape != register.shape:
        wanted, found = _shape(register.shape), _shape(array.shape)
        raise ValueRangeError(f"{register.path}: expected {wanted} elements, found {found}")
    return [_element(item, register.column) for item in array.ravel().tolist()]


def _array(value: object) -> Array:
    try:
        return np.asarray(value)
    except ValueError:  # rows of different lengths
        return np.empty(0)


def _element(value: object, column: Column) -> object:
    if column in _WHOLE and isinstance(value, (float, np.floating)) and float(value).is_integer():
        return int(value)
    if column is Column.BOOL and isinstance(value, np.bool_):
        return bool(value)
    return value


def _shape(shape: tuple[int, ...]) -> str:
    return " times ".join(map(str, shape)) or "no"


def _shorten(text: str) -> str:
    return text if len(text) <= _FAILURE_CHARACTERS else f"{text[: _FAILURE_CHARACTERS - 1]}…"
