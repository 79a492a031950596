"""One running FMU, with the same methods for FMI 2.0 and 3.0."""

from __future__ import annotations

import ctypes
import logging
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from shmio.errors import ModelError, ValueRangeError
from shmio.layout.topic import shorten
from shmio.logs import LogRateLimit
from shmio.simulation.fmu.description import Description, Variable
from shmio.simulation.images import Port, RegisterPort, joined_bytes
from shmio.wording import printable

WARNING: Final = 1
DISCARD: Final = 2
FATAL: Final = 4
MAX_UPDATES: Final = 1000
"""Maximum number of updates of discrete states at one event."""
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
_BOOLEAN: Final[Mapping[int, Any]] = {2: ctypes.c_int, 3: ctypes.c_bool}

log = logging.getLogger("shmio.fmu")
log.addFilter(LogRateLimit(one_kind=True))


class FmuError(ModelError):
    """A call to the FMU failed, so the FMU cannot be used any more."""


class Instance:
    """An FMU whose library is loaded. Use it in one thread only.

    A method that calls the FMU raises FmuError if the call fails. The calls of each step have
    prepared arguments, and go past FMPy's functions, which would convert all arguments again.
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
        self._has_events = False
        self.words = ""
        """The FMU's last message about a problem in the present call."""
        self._status = 0  # the worst status of all calls
        for event_mode in (True, False) if description.has_events else (False,):
            try:
                self._fmu: Any = instantiate_fmu(
                    str(folder),
                    description.parsed,
                    "CoSimulation",
                    logger=self._log,
                    early_return_allowed=description.returns_early,
                    event_mode_used=event_mode,
                )
                self._has_events = event_mode
                break
            except Exception as error:  # noqa: BLE001  FMPy raises Exception
                reason = shorten(printable(str(error)), 300)
                if not event_mode:
                    raise FmuError(self._with_words(f"it cannot be loaded: {reason}")) from None
                log.warning("the FMU cannot be loaded with the event mode that it states: %s", reason)
        self._component = ctypes.c_void_p(self._fmu.component)
        self._call_do_step: Callable[..., int] = self._fmu.dll[f"fmi{self.version}DoStep"]
        self._true = _BOOLEAN[self.version](1)
        self._event, self._terminates, self._is_early = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool()
        self._reached_s = ctypes.c_double()

    def group(self, variables: Iterable[Variable], ports: Mapping[str, Port]) -> list[Group]:
        """Divide variables into groups. One call to the FMU reads or writes all variables of a group."""
        by_type: dict[tuple[str, bool], list[Variable]] = {}
        for variable in variables:
            by_type.setdefault((variable.fmi_type, variable.discrete), []).append(variable)
        return [
            Group(self.version, self._fmu.dll, self._component, type_, alike, ports)
            for (type_, _), alike in by_type.items()
        ]

    def initialise(self, structure: list[Group], parameters: list[Group], inputs: list[Group]) -> None:
        """Set the parameters and inputs of the FMU, and initialise it.

        A group of parameters is left out if all its values equal the FMU's own. ``structure`` are the structural
        parameters, which determine the sizes of arrays.
        """
        with self._calling():
            if any(group.is_other for group in structure):
                self._fmu.enterConfigurationMode()
                for group in structure:
                    self._check(group.setter, group.set_other())
                self._fmu.exitConfigurationMode()
            for group in parameters:
                self._check(group.setter, group.set_other())
            if self.version == 2:
                self._fmu.setupExperiment(startTime=self._start_s)
                self._fmu.enterInitializationMode()
            else:
                self._fmu.enterInitializationMode(startTime=self._start_s)
            for group in inputs:
                self._check(group.setter, group.set_changed())
            self._fmu.exitInitializationMode()
            if self._has_events:
                self._update()

    def set(self, groups: list[Group]) -> None:
        """Give the FMU the values of each group in which a value has changed since the last call.

        Raises:
            ModelError: The FMU refuses a value. It can make further steps.

        """
        self.words = ""
        in_event_mode = False
        try:
            for group in groups:
                if self._has_events and group.is_discrete and not in_event_mode and group.is_changed:
                    with self._calling():
                        self._fmu.enterEventMode()  # discrete inputs can change only there
                    in_event_mode = True
                if (status := group.set_changed()) == DISCARD:
                    group.forget()
                    raise ModelError(self._with_words(f"{group.setter}: the FMU refuses a value of {group.names}"))
                if status > WARNING:
                    raise self._failed(group.setter, status)
        except FmuError:
            in_event_mode = False
            raise
        finally:
            if in_event_mode:
                self._update()

    def _update(self) -> None:
        """Let the FMU, which is in its event mode, compute its discrete states, and return to its step mode."""
        with self._calling():
            for _ in range(MAX_UPDATES):
                is_needed, terminates, *_ = self._fmu.updateDiscreteStates()
                if terminates:
                    raise FmuError(self._with_words("it has ended its simulation at an event"))
                if not is_needed:
                    break
            else:
                raise FmuError(self._with_words(f"its discrete states need more than {MAX_UPDATES} updates"))
            self._fmu.enterStepMode()

    def get(self, outputs: Outputs) -> None:
        """Read the values of all outputs from the FMU, and write them to the variables' ports.

        Raises:
            ValueRangeError: A value does not fit its register.

        """
        self.words = ""
        for call, arguments, group in outputs.calls:
            if (status := call(*arguments)) > WARNING:
                raise self._failed(group.getter, status)
            if group.is_text:
                group.keep_texts()
        for view, part in outputs.copies:
            view[:] = part
        for group in outputs.others:
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
        self.words = ""
        return self._do_step_2(now_s, size_s) if self.version == 2 else self._do_step_3(now_s, size_s)

    def _do_step_2(self, now_s: float, size_s: float) -> float | None:
        status = self._call_do_step(self._component, ctypes.c_double(now_s), ctypes.c_double(size_s), self._true)
        if status <= WARNING:
            return math.inf
        if status != DISCARD:
            raise self._failed("fmi2DoStep", status)
        if self._asked(self._fmu.getBooleanStatus, _TERMINATED):
            raise FmuError(self._with_words(f"it has ended its simulation at {now_s:g} s"))
        reached_s: float | None = self._asked(self._fmu.getRealStatus, _LAST_SUCCESSFUL_TIME)
        return reached_s

    def _asked(self, ask: Any, kind: int) -> Any:
        """Return a detail of a discarded step; None if the FMU does not know it."""
        try:
            return ask(kind)
        except self._error as error:
            if _status(error) != DISCARD:
                raise self.failed(error) from None
            return None

    def _do_step_3(self, now_s: float, size_s: float) -> float | None:
        event, terminates, is_early, reached_s = self._event, self._terminates, self._is_early, self._reached_s
        event.value = terminates.value = is_early.value = False
        reached_s.value = 0.0
        status = self._call_do_step(
            self._component, ctypes.c_double(now_s), ctypes.c_double(size_s), self._true, ctypes.byref(event),
            ctypes.byref(terminates), ctypes.byref(is_early), ctypes.byref(reached_s),
        )  # fmt: skip
        if status == DISCARD:
            return None
        self._check("fmi3DoStep", status)
        if terminates.value:
            raise FmuError(self._with_words(f"it has ended its simulation at {reached_s.value:g} s"))
        if self._has_events and event.value:
            with self._calling():
                self._fmu.enterEventMode()
            self._update()
        return reached_s.value if is_early.value else math.inf

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
        return self._failed(getattr(error, "function", "a call"), _status(error))

    def _check(self, function: str, status: int) -> None:
        """Check the status that a function of the FMU has returned."""
        if status > WARNING:
            raise self._failed(function, status)

    def _failed(self, function: str, status: int) -> FmuError:
        self._status = max(self._status, status)
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
    """Variables of one type. One call to the FMU reads or writes all their values, in one array.

    ``getter`` and ``setter`` are the names of the FMU's functions; ``call_get(*arguments)`` calls the
    first one. ``is_native`` is true if the values have the same bytes in the array and in the registers.
    """

    def __init__(
        self,
        version: int,
        library: Any,
        component: ctypes.c_void_p,
        type_: str,
        variables: list[Variable],
        ports: Mapping[str, Port],
    ) -> None:
        self.getter, self.setter = f"fmi{version}Get{type_}", f"fmi{version}Set{type_}"
        self.call_get: Callable[..., int] = library[self.getter]
        self._set: Callable[..., int] = library[self.setter]
        c_type: Any = _BOOLEAN[version] if type_ == "Boolean" else _C_TYPES[type_]
        self._is_boolean, self.is_text = type_ == "Boolean", type_ == "String"
        references = (ctypes.c_uint * len(variables))(*(one.reference for one in variables))
        self._ports = [ports[one.name] for one in variables]
        self._names = [one.name for one in variables]
        self.is_discrete = any(one.discrete for one in variables)
        self._arrays = any(one.shape for one in variables)
        self._shapes = [one.shape for one in variables]
        self._values = (c_type * sum(one.size for one in variables))()
        # FMI 3.0 has arrays, and therefore also needs the number of values.
        counts = (ctypes.c_size_t(len(self._values)),) if version == 3 else ()
        self.arguments = component, references, ctypes.c_size_t(len(variables)), self._values, *counts
        registers = [port for port in self._ports if isinstance(port, RegisterPort)]
        self.is_native = all(port.is_native for port in registers)
        self._views = joined_bytes(registers)
        self._parts = _split(memoryview(self._values).cast("B"), self._views) if self.is_native else []
        self.copies = list(zip(self._views, self._parts, strict=True)) if self.is_native else []
        """The bytes of registers, and those of the array from which they are copied."""
        self._given_bytes: list[bytes] | None = None
        self._given: list[object] = []
        self._starts = [_start(one) for one in variables]
        self._texts: list[bytes | None] = []
        self._shown: tuple[list[bytes | None], list[bytes]] = [], []  # the texts shown last, and their registers' bytes

    def keep_texts(self) -> None:
        """Copy the texts that the FMU has returned, because they remain only until the next call."""
        self._texts = list(self._values)

    def forget(self) -> None:
        """Make the next :meth:`set_changed` give the FMU all values, even if none has changed."""
        self._given_bytes, self._given = None, []

    def show(self) -> None:
        """Write the values that the FMU has returned to the ports.

        Raises:
            ValueRangeError: A value does not fit its register.

        """
        if self.is_text:
            self._show_texts()
        else:
            self._show([bool(value) for value in self._values] if self._is_boolean else list(self._values))

    def _show_texts(self) -> None:
        texts, data = self._shown
        if texts == self._texts:  # most texts never change
            for view, one in zip(self._views, data, strict=True):
                view[:] = one
            return
        shown = [self._text(text or b"") for text in self._texts]
        try:
            self._show(shown)
        except ValueRangeError as error:
            longest = max(len(text.encode("utf-16-le")) // 2 for text in shown)
            raise ValueRangeError(f"{error}; the source needs text_length = {longest}") from None
        self._shown = self._texts, [bytes(view) for view in self._views]

    def _text(self, data: bytes) -> str:
        """Return a text of the FMU. FMI demands UTF-8."""
        try:
            return data.decode()
        except UnicodeDecodeError:
            log.warning(
                "the FMU returned a text that is not UTF-8 for one of %s; � stands for its wrong bytes", self.names
            )
            return data.decode(errors="replace")

    def _show(self, values: list[Any]) -> None:
        if not self._arrays:
            for port, value in zip(self._ports, values, strict=True):
                port.write(value)
            return
        place = 0
        for port, shape in zip(self._ports, self._shapes, strict=True):
            count = math.prod(shape)
            port.write(_shaped(values[place : place + count], shape))
            place += count

    @property
    def names(self) -> str:
        """The names of the variables, for messages."""
        return shorten(printable(", ".join(self._names)))

    @property
    def is_changed(self) -> bool:
        """True if the registers' bytes are others than at the last call of :meth:`set_changed`."""
        return [bytes(view) for view in self._views] != self._given_bytes

    @property
    def is_other(self) -> bool:
        """True if a port has another value than the FMU's own initial one."""
        return [port.read() for port in self._ports] != self._starts

    def set_other(self) -> int:
        """Give the FMU the values of the ports, unless they all equal its own initial values. Return the status."""
        return self.set_changed() if self.is_other else 0

    def set_changed(self) -> int:
        """Give the FMU the values of all ports if any of them has changed since the last call. Return the status.

        Raises:
            ModelError: An input is no text that C can read.

        """
        given_bytes = [bytes(view) for view in self._views]
        if given_bytes == self._given_bytes:
            return 0
        is_new = True
        if self.is_native:
            for part, data in zip(self._parts, given_bytes, strict=True):
                part[:] = data
        else:
            given = [port.read() for port in self._ports]
            is_new = given != self._given
            if is_new:
                self._values[:] = self._flat(given)
                self._given = given
        self._given_bytes = given_bytes  # only now: bytes that are no valid text also fail in the next step
        return self._set(*self.arguments) if is_new else 0

    def _flat(self, given: list[Any]) -> list[Any]:
        """Return the values of the ports as values for the array."""
        if not self.is_text:
            return [one for value in given for one in _flat(value)] if self._arrays else given
        texts: list[bytes] = []
        for name, value in zip(self._names, given, strict=True):
            for text in _flat(value):
                if text is None or "\0" in text:
                    raise ModelError(f"{name} has bytes that are no text, or a text with a NUL character")
                texts.append(text.encode())
        return texts


class Outputs:
    """The outputs of an FMU, prepared for :meth:`Instance.get`."""

    def __init__(self, groups: list[Group]) -> None:
        self.calls = [(group.call_get, group.arguments, group) for group in groups]
        self.copies = [copy for group in groups for copy in group.copies]
        self.others = [group for group in groups if not group.is_native]


def _split(data: memoryview, views: Iterable[memoryview]) -> list[memoryview]:
    """Return the bytes of an array of values, divided like the registers' bytes."""
    parts, place = [], 0
    for view in views:
        parts.append(data[place : place + len(view)])
        place += len(view)
    return parts


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
