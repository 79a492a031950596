"""One running FMU, with the same methods for FMI 2.0 and 3.0."""

from __future__ import annotations

import ctypes
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from shmio.errors import ModelError
from shmio.layout.topic import shorten
from shmio.logs import LogRateLimit
from shmio.simulation.fmu.description import Description, Variable
from shmio.simulation.images import Port, RegisterPort
from shmio.wording import printable

DISCARD: Final = 2
FATAL: Final = 4
STATUSES: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
_LAST_SUCCESSFUL_TIME: Final = 2
_TERMINATED: Final = 3
_C_TYPES: Final[Mapping[str, Any]] = {
    "Real": ctypes.c_double,
    "Integer": ctypes.c_int,
    "Float32": ctypes.c_float,
    "Float64": ctypes.c_double,
    "Int8": ctypes.c_int8,
    "UInt8": ctypes.c_uint8,
    "Int16": ctypes.c_int16,
    "UInt16": ctypes.c_uint16,
    "Int32": ctypes.c_int32,
    "UInt32": ctypes.c_uint32,
    "Int64": ctypes.c_int64,
    "UInt64": ctypes.c_uint64,
    "String": ctypes.c_char_p,
}
_BOOLEAN: Final = {2: ctypes.c_int, 3: ctypes.c_bool}

log = logging.getLogger("shmio.fmu")
log.addFilter(LogRateLimit(one_kind=True))


class FmuError(ModelError):
    """A call to the FMU failed, so the FMU cannot be used any more."""


class Instance:
    """An FMU whose library is loaded. Use it in one thread only.

    A method that calls the FMU raises FmuError if the call fails.
    """

    def __init__(self, description: Description, folder: Path) -> None:
        """Load the library, and create the FMU.

        Args:
            description: The FMU's description.
            folder: The folder with the FMU's files.

        """
        from fmpy.fmi1 import FMICallException  # noqa: PLC0415  only FMUs need it
        from fmpy.simulation import instantiate_fmu  # noqa: PLC0415

        self._error: type[Exception] = FMICallException
        self.version = description.version
        self._start_s = description.start_s
        self.words = ""
        """The FMU's last message about a problem in the present call."""
        self._status = 0  # the worst status of all calls
        try:
            self._fmu: Any = instantiate_fmu(
                str(folder),
                description.parsed,
                "CoSimulation",
                logger=self._log,
                early_return_allowed=description.returns_early,
            )
        except Exception as error:  # noqa: BLE001  FMPy raises Exception
            raise FmuError(self._with_words(f"it cannot be loaded: {shorten(printable(str(error)), 300)}")) from None

    def group(self, variables: Iterable[Variable], ports: Mapping[str, Port]) -> list[Group]:
        """Divide variables into groups. One call to the FMU reads or writes all variables of a group."""
        by_type: dict[str, list[Variable]] = {}
        for variable in variables:
            by_type.setdefault(variable.fmi_type, []).append(variable)
        return [Group(self.version, self._fmu, type_, alike, ports) for type_, alike in by_type.items()]

    def initialise(self, parameters: list[Group], inputs: list[Group]) -> None:
        """Set the parameters and inputs of the FMU, and initialise it.

        A group of parameters is left out if all its values equal the FMU's own.
        """
        with self._calling():
            for group in parameters:
                group.set_other(self._fmu.component)
            if self.version == 2:
                self._fmu.setupExperiment(startTime=self._start_s)
                self._fmu.enterInitializationMode()
            else:
                self._fmu.enterInitializationMode(startTime=self._start_s)
            for group in inputs:
                group.set_changed(self._fmu.component)
            self._fmu.exitInitializationMode()

    def set(self, groups: list[Group]) -> None:
        """Give the FMU the values of each group in which a value has changed since the last call."""
        with self._calling():
            for group in groups:
                group.set_changed(self._fmu.component)

    def get(self, groups: list[Group]) -> None:
        """Read the values of all variables in ``groups`` from the FMU, and write them to the variables' ports.

        Raises:
            ValueRangeError: A value does not fit its register.

        """
        with self._calling():
            for group in groups:
                group.get(self._fmu.component)
        for group in groups:
            group.show()

    def save(self) -> bytes:
        """Return the FMU's state as bytes."""
        with self._calling():
            get, free, to_bytes, _, _ = self._state_calls()
            state = get()
            try:
                return bytes(to_bytes(state))
            finally:
                free(state)

    def restore(self, data: bytes) -> None:
        """Restore a state that :meth:`save` has returned."""
        with self._calling():
            _, free, _, from_bytes, put = self._state_calls()
            state = from_bytes(data)
            try:
                put(state)
            finally:
                free(state)

    def _state_calls(self) -> tuple[Callable[..., Any], ...]:
        fmu = self._fmu
        if self.version == 2:
            return (fmu.getFMUstate, fmu.freeFMUstate, fmu.serializeFMUstate, fmu.deSerializeFMUstate, fmu.setFMUstate)
        return (fmu.getFMUState, fmu.freeFMUState, fmu.serializeFMUState, fmu.deserializeFMUState, fmu.setFMUState)

    def do_step(self, now_s: float, size_s: float) -> float | None:
        """Let the FMU step from ``now_s`` by ``size_s``, both in s of the FMU's own time.

        Returns:
            The time that the FMU has reached, if that is less than the end of the step; infinity if
            it has completed the step; None if it has discarded the step.

        """
        with self._calling():
            return self._do_step_2(now_s, size_s) if self.version == 2 else self._do_step_3(now_s, size_s)

    def _do_step_2(self, now_s: float, size_s: float) -> float | None:
        try:
            self._fmu.doStep(now_s, size_s)
        except self._error as error:
            if _status(error) != DISCARD:
                raise
            if self._asked(self._fmu.getBooleanStatus, _TERMINATED):
                raise FmuError(self._with_words(f"it has ended its simulation at {now_s:g} s")) from None
            reached_s: float | None = self._asked(self._fmu.getRealStatus, _LAST_SUCCESSFUL_TIME)
            return reached_s
        return math.inf

    def _asked(self, ask: Any, kind: int) -> Any:
        """Return a detail of a discarded step; None if the FMU does not know it."""
        try:
            return ask(kind)
        except self._error as error:
            if _status(error) != DISCARD:
                raise
            return None

    def _do_step_3(self, now_s: float, size_s: float) -> float | None:
        try:
            _, terminates, is_early, reached_s = self._fmu.doStep(now_s, size_s)
        except self._error as error:
            if _status(error) != DISCARD:
                raise
            return None
        if terminates:
            raise FmuError(self._with_words(f"it has ended its simulation at {reached_s:g} s"))
        return float(reached_s) if is_early else math.inf

    def close(self) -> None:
        """End the simulation, and unload the library."""
        if self._status >= FATAL:  # nothing may be called
            return
        try:
            if self._status < FATAL - 1:
                self._fmu.terminate()
            self._fmu.freeInstance()
        except Exception as error:  # noqa: BLE001  nothing more can be done
            log.warning("the FMU did not end cleanly: %s", shorten(printable(str(error))))

    def _calling(self) -> _Call:
        return _Call(self)

    def failed(self, error: Exception) -> FmuError:
        """Convert FMPy's exception about a failed call to an FmuError, and remember the call's status."""
        self._status = max(self._status, _status(error))
        function = getattr(error, "function", "a call")
        status = _status(error)
        name = STATUSES[status] if 0 <= status < len(STATUSES) else str(status)
        return FmuError(self._with_words(f"{function} failed with status {name}"))

    @property
    def error(self) -> type[Exception]:
        """The class of the exceptions that FMPy raises for failed calls."""
        return self._error

    def _with_words(self, text: str) -> str:
        """Return a message, followed by the FMU's last message."""
        return f"{text}: {self.words}" if self.words else text

    def _log(self, *arguments: Any) -> None:
        """Log a message of the FMU: the last arguments are status, category and message."""
        status, message = arguments[-3], arguments[-1] or b""
        text = shorten(printable(" ".join(message.decode(errors="replace").split())), 300)
        if status:
            self.words = text
            log.warning("the FMU says: %s", text)
        else:
            log.info("the FMU says: %s", text)


def _status(error: Exception) -> int:
    return int(getattr(error, "status", 0))


class _Call:
    """Turns FMPy's errors about calls into FmuErrors, as a context manager."""

    __slots__ = ("_instance",)

    def __init__(self, instance: Instance) -> None:
        self._instance = instance

    def __enter__(self) -> None:
        self._instance.words = ""

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, self._instance.error):
            raise self._instance.failed(error) from None


class Group:
    """Variables of one type. One call to the FMU reads or writes all their values, in one array."""

    def __init__(
        self, version: int, fmu: Any, type_: str, variables: list[Variable], ports: Mapping[str, Port]
    ) -> None:
        self._get: Callable[..., object] = getattr(fmu, f"fmi{version}Get{type_}")
        self._set: Callable[..., object] = getattr(fmu, f"fmi{version}Set{type_}")
        c_type: Any = _BOOLEAN[version] if type_ == "Boolean" else _C_TYPES[type_]
        self._is_boolean, self._is_text = type_ == "Boolean", type_ == "String"
        self._references = (ctypes.c_uint * len(variables))(*(one.reference for one in variables))
        self._ports = [ports[one.name] for one in variables]
        self._arrays = any(one.shape for one in variables)
        self._shapes = [one.shape for one in variables]
        self._values = (c_type * sum(one.size for one in variables))()
        self._parts = list(self._split())
        # FMI 3.0 has arrays, and therefore also needs the number of values.
        counts = (len(self._values),) if version == 3 else ()
        self._arguments = self._references, len(variables), self._values, *counts
        views = [port.native if isinstance(port, RegisterPort) else None for port in self._ports]
        self._views = [view for view in views if view is not None]
        self._is_native = len(self._views) == len(views)  # then the bytes are copied as they are
        self._given_bytes: list[bytes] = []
        self._starts = [_start(one) for one in variables]
        self._given: list[object] = []

    def _split(self) -> Iterator[memoryview]:
        """Yield the bytes of each variable in the array."""
        data = memoryview(self._values).cast("B")
        item, place = ctypes.sizeof(self._values) // max(1, len(self._values)), 0
        for shape in self._shapes:
            size = item * math.prod(shape)
            yield data[place : place + size]
            place += size

    def get(self, component: object) -> None:
        """Read the values from the FMU into the array; :meth:`show` writes them to the ports."""
        self._get(component, *self._arguments)

    def forget(self) -> None:
        """Make the next :meth:`set_changed` give the FMU all values, even if none has changed."""
        self._given, self._given_bytes = [], []

    def show(self) -> None:
        """Write the values that :meth:`get` has read to the ports.

        Raises:
            ValueRangeError: A value does not fit its register.

        """
        if self._is_native:
            for view, part in zip(self._views, self._parts, strict=True):
                view[:] = part
            return
        values: list[Any] = list(self._values)
        if self._is_boolean:
            values = [bool(value) for value in values]
        elif self._is_text:
            values = [(value or b"").decode(errors="replace") for value in values]
        if not self._arrays:
            for port, value in zip(self._ports, values, strict=True):
                port.write(value)
            return
        place = 0
        for port, shape in zip(self._ports, self._shapes, strict=True):
            count = math.prod(shape)
            port.write(_shaped(values[place : place + count], shape))
            place += count

    def set_other(self, component: object) -> None:
        """Give the FMU the values of the ports, unless they all equal the FMU's own initial values."""
        self._given = self._starts
        self.set_changed(component)

    def set_changed(self, component: object) -> None:
        """Give the FMU the values of all ports if any of them has changed since the last call."""
        if self._is_native:
            given_bytes = [bytes(view) for view in self._views]
            if given_bytes == self._given_bytes:
                return
            self._given_bytes = given_bytes
        given = [port.read() for port in self._ports]
        if given == self._given:
            return
        flat = [one for value in given for one in _flat(value)] if self._arrays else given
        self._values[:] = [one.encode() for one in flat] if self._is_text else flat
        self._set(component, *self._arguments)
        self._given = given


def _start(variable: Variable) -> object:
    """Return the value with which the FMU begins, as a port reads it; if it is unknown, zero or empty text."""
    initial = variable.initial
    if initial is None:
        zero = "" if variable.fmi_type == "String" else 0
        return _frozen(_shaped([zero] * variable.size, variable.shape)) if variable.shape else zero
    return _frozen(_shaped(initial, variable.shape)) if variable.shape else initial


def _shaped(values: Any, shape: tuple[int, ...]) -> Any:
    """Return the values of an array as nested lists, as registers have them."""
    if not shape:
        return values[0]
    if len(shape) == 1:
        return list(values)
    size = len(values) // shape[0]
    return [_shaped(values[start : start + size], shape[1:]) for start in range(0, len(values), size)]


def _flat(value: Any) -> Iterable[Any]:
    if isinstance(value, tuple):
        for one in value:
            yield from _flat(one)
    else:
        yield value


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
