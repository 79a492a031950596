"""Messages between an endpoint and a program that is the model of a source. This module does no I/O."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from shmio.client import calls
from shmio.client.table import FIELDS, Array, Register, Table
from shmio.errors import ConflictError, LostError, PathError, RemoteError, ShmioError, ValueRangeError
from shmio.model.values import Column
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wording import unknown

RETRY_S: Final = 0.25
"""Time between two attempts to join, in s."""
PATIENCE_S: Final = 10.0
"""Time in s for which a model tries again to join an instance that does not run."""
_WHOLE: Final = frozenset({Column.INT32, Column.INT64, Column.UINT64})
_CONVERTED: Final = _WHOLE | {Column.BOOL}
"""Columns for which :func:`_element` converts values."""
_FAILURE_CHARACTERS: Final = 400

log = logging.getLogger("shmio.client")


class Values(Mapping[str, Any]):
    """Values by path without the source: numpy scalars and arrays, and texts.

    None stands for bytes that are not a valid value. The next step replaces the values in this
    mapping.
    """

    def __init__(self, table: Table) -> None:
        self._table = table
        self.changed: tuple[str, ...] = ()
        """Paths of the values that came with the present step. The first step brings all values."""

    def __getitem__(self, path: str) -> Any:
        """Return a register's value; raise PathError if there is no such register."""
        return self._table.value(self._table.place(path))

    def __contains__(self, path: object) -> bool:
        return path in self._table.places

    def __iter__(self) -> Iterator[str]:
        return iter(self._table.places)

    def __len__(self) -> int:
        return len(self._table.registers)


class Work:
    """A step for the model to compute.

    Attributes:
        time_s: Simulation time after the step, in s.
        dt_s: Length of the step, in s.
        doubt: Reason why the inputs may be wrong; empty if there is none.
        refused: Reason why the previous answer was refused; empty if it was accepted.
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
        """Simulation time after the step, in s."""
        return self.time_ns / 1e9

    @property
    def dt_s(self) -> float:
        """Length of the step, in s."""
        return self.dt_ns / 1e9


class _Output(NamedTuple):
    """An output.

    ``field`` is the name of the field with its values. ``converted`` is True if protobuf may accept
    its values only after a conversion.
    """

    register: Register
    field: str
    converted: bool


class Part:
    """Reads the requested steps of a source that a program computes, and makes the answers."""

    def __init__(self, found: Any) -> None:
        """Read the endpoint's first answer. Raise RemoteError if it is None or invalid."""
        if found is None or found.WhichOneof("what") != "joined":
            raise RemoteError("the endpoint's first answer to Simulate is invalid")
        joined = found.joined
        self._inputs = Table(joined.inputs)
        self._outputs = Table(joined.outputs)
        self._outputs.apply(joined.values)
        self.source: str = self._inputs.source
        self.inputs = Values(self._inputs)
        self.outputs = Values(self._outputs)
        self._by_path: dict[str, _Output] = {}  # by the paths that the model has used
        self.computed: bool = joined.computed
        self.clock = calls.clock(joined.clock)
        self.period_s: float = joined.period_ns / 1e9

    def take(self, found: Any) -> Work:
        """Return the step that a message requests, and update the inputs.

        Raises:
            RemoteError: The message is invalid.
        """
        if found.WhichOneof("what") != "work":
            raise RemoteError("the endpoint sent something other than a step")
        work = found.work
        changes = self._inputs.apply(work.values) if work.HasField("values") else ()
        if work.HasField("invalid"):
            self._inputs.mark(work.invalid, self._inputs.invalid)
        registers = self._inputs.registers
        self.inputs.changed = tuple(registers[place].path for place in self._inputs.changed(changes))
        return Work(work, self.inputs)

    def done(self, step: int, outputs: Mapping[str, object]) -> bytes:
        """Return the answer to a step.

        Raises:
            PathError: There is no such output.
            ValueRangeError: A value does not fit its register.
        """
        fields: dict[str, tuple[list[int], list[Any]]] = {}
        for path, value in outputs.items():
            output = self._by_path.get(path) or self._find(path)
            register = output.register
            slots, values = fields.get(output.field) or fields.setdefault(output.field, ([], []))
            if register.dims:
                slots += range(register.slot, register.slot + register.count)
                values += _flat(value, output)
            else:
                slots.append(register.slot)
                values.append(_element(value, register.column) if output.converted else value)
        try:
            return _answer(step, fields)
        except (TypeError, ValueError, OverflowError):
            for path, value in outputs.items():
                _check(value, self._find(path))
            raise

    def _find(self, path: str) -> _Output:
        try:
            register = self._outputs.registers[self._outputs.place(path)]
        except PathError:
            raise PathError(unknown("output", path, self.outputs, self.source)) from None
        output = self._by_path[path] = _Output(register, FIELDS[register.column], register.column in _CONVERTED)
        return output

    @staticmethod
    def failed(step: int, reason: str) -> bytes:
        """Return the answer that tells the endpoint that the step has failed, and why."""
        return wire.SimulateRequest(done=wire.Done(step=step, failure=_shorten(reason))).SerializeToString()


class Member:
    """The source whose model this program is.

    Attributes:
        inputs: Present inputs by path.
        outputs: Outputs by path, with the values that consumers saw when the model joined.
        computed: True if a model computed these outputs; otherwise, they are initial values.
        clock: State of the clock when the model joined.
        period_s: Time between two steps while time is real, in s.
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
        """Return the number of the step to answer. Raise RemoteError if no step is requested."""
        if self._work is None:
            raise RemoteError(f"{self.source}: there is no step to answer")
        return self._work.step


def join_request(source: str, name: str) -> bytes:
    """Return the first request of the call Simulate, with which the model joins a source."""
    return wire.SimulateRequest(join=wire.Join(source=source, name=name)).SerializeToString()


class Rejoining:
    """Remembers a model's outputs, so that it can join again with them after a lost connection."""

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._lost_s: float | None = time.monotonic()
        self._joined = False
        self._known: dict[str, object] = {}  # latest outputs by path
        self._sent = True  # True if the present endpoint has all of these outputs
        self._failure = ""

    def joined(self) -> None:
        """Remember that the model has joined."""
        self._lost_s, self._sent, self._joined = None, not self._joined, True

    def patient(self, error: ShmioError) -> bool:
        """Return whether the model should try to join again after an error."""
        if self._lost_s is None:
            self._lost_s = time.monotonic()
        # For a while after a lost connection, the endpoint may still count this client as connected.
        again = isinstance(error, LostError) or (self._joined and isinstance(error, ConflictError))
        return again and time.monotonic() - self._lost_s < self._patience_s

    def heed(self, part: Part, work: Work) -> None:
        """Log why the endpoint refused the previous answer, if it refused the answer."""
        if work.refused:
            log.warning("%s: %s", part.source, work.refused)

    def answer(self, part: Part, work: Work, outputs: Mapping[str, object] | None) -> bytes:
        """Return the answer with the outputs; the first answer after a rejoin has all outputs.

        Raises:
            PathError, ValueRangeError: As for :meth:`Part.done`.
        """
        outputs = {} if outputs is None else outputs
        if not isinstance(outputs, Mapping):
            raise ValueRangeError(
                f"step returned {_shorten(repr(outputs))}, but must return a mapping from the "
                "paths of outputs to their values, or None"
            )
        answer = part.done(work.step, outputs if self._sent else {**self._known, **outputs})
        self._known.update(outputs)
        self._sent, self._failure = True, ""
        return answer

    def failed(self, part: Part, work: Work, error: Exception) -> bytes:
        """Return the answer that the step has failed. Log the reason if it is not that of the last failure."""
        text = explain(error)
        if text != self._failure:
            self._failure = text
            log.warning("%s: step %d failed: %s", part.source, work.step, text)
            log.debug("%s: step %d", part.source, work.step, exc_info=error)
        return part.failed(work.step, text)


def explain(error: Exception) -> str:
    """Describe an error of the program's code in one line, with file and line number."""
    if isinstance(error, ShmioError):
        return _shorten(" ".join(str(error).split()))
    where = ""
    if frames := traceback.extract_tb(error.__traceback__):
        where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})"
    return _shorten(" ".join(f"{type(error).__name__}: {error}".split())) + where


def _answer(step: int, fields: Mapping[str, tuple[list[int], list[Any]]]) -> bytes:
    request = wire.SimulateRequest()
    done = request.done
    done.step = step
    done.values.SetInParent()
    for name, (slots, values) in fields.items():
        part = getattr(done.values, name)
        part.slots.extend(slots)
        part.values.extend(values)
    return request.SerializeToString()


def _check(value: object, output: _Output) -> None:
    """Raise ValueRangeError if protobuf cannot hold the value in its column."""
    register = output.register
    try:
        _answer(0, {output.field: ([], list(_flat(value, output)))})
    except (TypeError, ValueError, OverflowError):
        raise ValueRangeError(f"{register.path}: expected {register.type}, found {_shorten(repr(value))}") from None


def _flat(value: object, output: _Output) -> Iterable[object]:
    """Return the elements of a value in the order of its column.

    Raises:
        ValueRangeError: The value has the wrong shape.
    """
    register = output.register
    if not register.dims:
        return (_element(value, register.column),)
    array: Array = np.frombuffer(value, np.uint8) if isinstance(value, (bytes, bytearray)) else _array(value)
    if array.shape != register.shape:
        wanted, found = _shape(register.shape), _shape(array.shape)
        raise ValueRangeError(f"{register.path}: expected {wanted} elements, found {found}")
    items: list[object] = array.ravel().tolist()
    return [_element(item, register.column) for item in items] if output.converted else items


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
