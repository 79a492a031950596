"""Runs a model in the process of a source, or in a client of an instance on another host."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final, Protocol

import msgspec
import numpy as np

from shmio.errors import ConfigError, LayoutError, ModelError, PathError, SnapshotError, ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout, Register
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import Write
from shmio.model.snapshot import decode_part
from shmio.simulation.images import Ends, Images, Port, RegisterPort, port_of
from shmio.simulation.model import (
    Declaration,
    InOut,
    Input,
    Model,
    Output,
    Parameter,
    declared,
    explain,
    layout_of,
    place_declarations,
)
from shmio.simulation.state import decode_state, encode_state
from shmio.wording import unknown

_TEXTS: Final = frozenset({"STRING", "WSTRING"})
NOTHING: Final[Mapping[str, object]] = MappingProxyType({})


class ModelRunner:
    """Runs one model on the images of its block. Use it from one thread.

    There are two images. The commanded image has the values that clients and connections have
    written: to inputs, to the ``/in`` of in-out registers, and to registers that the model does not
    declare. The shown image has the values that readers see. A value that was written to an input
    or to an undeclared register appears in the shown image with the next step.
    """

    def __init__(
        self,
        model: type[Model],
        layout: Layout | None = None,
        parameters: Mapping[str, object] = NOTHING,
        seed: int = 0,
    ) -> None:
        """Create the model.

        Args:
            model: The model's class.
            layout: A layout with at least the declared registers. Default: the layout of the
                declarations.
            parameters: Values of parameters, by name.
            seed: The seed of the model's randomness.

        Raises:
            ConfigError: The layout lacks a register, a parameter is unknown, or its value does not
                fit. The message begins with the key.

        """
        model, parameters = model.with_parameters(parameters)
        self.name = model.reference
        self.notices = model.notices
        """What the user should know about the model."""
        self._version = _version(model)  # now, because the files may change
        self.layout = layout_of(model) if layout is None else layout
        found = {declaration: self._find(model, declaration) for declaration in declared(model, Input, Output, InOut)}
        outputs = [r for declaration in found if isinstance(declaration, Output) for r in found[declaration].values()]
        both = [r for declaration in found if isinstance(declaration, InOut) for r in found[declaration].values()]
        self._images = Images(self.layout, outputs, both)
        self.computed = (*outputs, *both)
        """The output and in-out registers, whose shown values the model computes."""
        self._inputs: dict[str, RegisterPort] = {}
        ports: dict[str, Port] = _parameters(model, parameters)
        ends: dict[str, Ends] = {}
        limited: list[RegisterPort] = []
        order = self.layout.byte_order
        for declaration, registers in found.items():
            commanded = port_of(declaration.path, registers, order, self._images.commanded, declaration.limits)
            shown = port_of(declaration.path, registers, order, self._images.shown)
            if isinstance(declaration, Output):
                ports[declaration.name] = shown
                continue
            own = {
                r.path: RegisterPort(r, order, self._images.commanded, declaration.limits) for r in registers.values()
            }
            self._inputs |= own
            if declaration.limits is not None:
                limited += own.values()
            for path, port in own.items() if isinstance(declaration.limits, Mapping) else ():
                if fault := port.fault(port.read()):
                    raise ConfigError(f"layout: {path}: {fault}; give the register an initial value")
            if isinstance(declaration, InOut):
                ends[declaration.name] = Ends(commanded, shown)
            else:
                ports[declaration.name] = commanded
        self._images.limited = limited
        self._model = model(ports, ends, seed)
        self._started = False

    @property
    def inputs(self) -> tuple[str, ...]:
        """The paths of the registers that :meth:`connect` can set."""
        return tuple(self._inputs)

    @property
    def image(self) -> bytes:
        """A copy of the shown image of the whole block."""
        return bytes(self._images.shown)

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Write bytes and bits into the commanded image, for the next step.

        Args:
            writes: The writes, in order.

        Returns:
            For each write, "" or why it is refused. A write is refused if it would change an
            output, lies outside the block, or has a value outside the register's limits.

        """
        return self._images.write(writes)

    def connect(self, values: Mapping[str, object]) -> None:
        """Set the values of inputs for the next step. All other inputs keep their values.

        Args:
            values: Values by the paths of the inputs.

        Raises:
            PathError: There is no such input. All values before it have been set.
            ValueRangeError: A value does not fit. All values before it have been set.

        """
        for path, value in values.items():
            port = self._inputs.get(path)
            if port is None:
                raise PathError(unknown("input", path, self._inputs, f"model {self.name}"))
            port.write(value)

    def begin(self) -> bytes:
        """Start the model, unless it was started before.

        Returns:
            The image before the first step.

        Raises:
            ModelError: The model's code failed.

        """
        if not self._started:
            self._run(self._model.start)
            self._started = True
        return self.image

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Compute one step.

        Args:
            time_ns: The simulation time at the end of the step, in ns.
            dt_ns: The length of the step, in ns.

        Returns:
            The shown image of the whole block.

        Raises:
            ModelError: The model's code failed. The image is unchanged.

        """
        if not self._started:
            self.begin()
        before = self.image
        self._images.show_given()
        self._run(self._model.step, time_ns / 1e9, dt_ns / 1e9, instead=before)
        return self.image

    def resume(self, image: bytes) -> None:
        """Continue from an image: set both images to it.

        Raises:
            LayoutError: The image has the wrong size.

        """
        try:
            self._images.resume(image)
        except LayoutError as error:
            raise LayoutError(f"model {self.name}: {error}") from None

    def save(self) -> bytes:
        """Return the state of the model and both images, for a snapshot.

        Raises:
            SnapshotError: The model's state cannot be saved. The message names the reason.
            ModelError: The model's code failed.

        """
        self.begin()
        states: list[bytes] = []
        self._run(lambda: states.append(self._encoded(self._model.save_state())))
        images = self._images
        saved = _Saved(
            self.name, self._version, bytes(images.commanded), bytes(images.shown),
            encode_state(self._model.random, None, ()), states[0],
        )  # fmt: skip
        return msgspec.msgpack.encode(saved)

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check the state of a snapshot, and return the function that restores it.

        Raises:
            SnapshotError: The state is damaged, or is that of another model or another version of
                it.

        """
        saved = decode_part(data, _Saved, f"model {self.name}: the state")
        if saved.model != self.name:
            raise SnapshotError(f"the snapshot has the state of model {saved.model}, but the model is {self.name}")
        if saved.version != self._version:
            raise SnapshotError(f"model {self.name}: its code has changed since the snapshot was saved")
        if {len(saved.commanded), len(saved.shown)} != {len(self._images.shown)}:
            raise SnapshotError(f"model {self.name}: the snapshot has images of another size")
        generator = decode_state(saved.random, None, ())
        if not isinstance(generator, np.random.Generator):
            raise SnapshotError(f"model {self.name}: the state is damaged: it has no random generator")
        state = decode_state(saved.state, self._model, _modules(self._model))

        def restore() -> None:
            self.begin()
            self._images.restore(saved.commanded, saved.shown)
            self._model.random = generator
            self._run(lambda: self._model.restore_state(state))

        return restore

    def _encoded(self, state: object) -> bytes:
        return encode_state(state, self._model, _modules(self._model))

    def close(self) -> None:
        """Release what the model holds, such as the library of an FMU. The model cannot step any more."""
        self._model._close()

    def _run(self, call: Callable[..., object], *arguments: float, instead: bytes | None = None) -> None:
        """Call the model's code. If it fails, restore the shown image."""
        before = self.image if instead is None else instead
        try:
            call(*arguments)
        except (ModelError, SnapshotError) as error:  # its message already says what has failed, and where
            self._images.shown[:] = before
            raise type(error)(f"model {self.name}: {error}") from error
        except (Exception, SystemExit) as error:
            self._images.shown[:] = before
            raise ModelError(f"model {self.name}: {explain(error, self._model.__module__)}") from error

    def _find(self, model: type[Model], declaration: Declaration) -> dict[str, Register]:
        """Return the registers of a declaration, by their paths within it.

        Raises:
            ConfigError: The layout lacks a register, or the register has another type in the
                layout.

        """
        found: dict[str, Register] = {}
        for member, path in declaration.paths.items():
            own = find(layout_of(model), path)
            try:
                register = found[member] = find(self.layout, path)
            except PathError as error:
                raise ConfigError(f"layout: model {self.name} needs a register {path}, {_kind(own)}: {error}") from None
            both_text = declaration.any_text and _TEXTS.issuperset((register.element.base, own.element.base))
            if register.dims != own.dims or (register.type != own.type and not both_text):
                raise ConfigError(
                    f"layout: model {self.name} needs {path} as {_kind(own)}; in {self.layout.name} it is "
                    f"{_kind(register)}"
                )
        return found


def _parameters(model: type[Model], given: Mapping[str, object]) -> dict[str, Port]:
    """Return the ports of a model's parameters, with the values in ``given``.

    Raises:
        ConfigError: A name is unknown, or a value does not fit.

    """
    layout = place_declarations(model.__qualname__, declared(model, Parameter))
    values, _ = initial_frame(layout)
    ports: dict[str, Port] = {}
    for declaration in declared(model, Parameter):
        registers = {member: find(layout, path) for member, path in declaration.paths.items()}
        ports[declaration.name] = port_of(declaration.name, registers, layout.byte_order, values, declaration.limits)
    for name, value in given.items():
        if name not in ports:
            raise ConfigError(f"parameters.{name}: {unknown('parameter', name, ports, f'model {model.__qualname__}')}")
        try:
            ports[name].write(value)
        except ValueRangeError as error:
            raise ConfigError(f"parameters.{error}") from None
    return ports


class _Saved(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The state of a model in a snapshot. ``version`` is the digest of the model's code."""

    model: str
    version: str
    commanded: bytes
    shown: bytes
    random: bytes
    state: bytes


def _modules(model: Model) -> frozenset[str]:
    """Return the names of the modules whose classes a model's state may have."""
    own = {base.__module__ for base in type(model).__mro__} - {"abc", "builtins"}
    return frozenset(own | set(model.state_modules))


@lru_cache(maxsize=256)
def _version(model: type[Model]) -> str:
    """Return the SHA-256 of the files of a model's code; of the FMU's file for an FMU.

    If a file cannot be read, the version is unique.
    """
    digest = hashlib.sha256()
    for file in model.code_files():
        try:
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        except OSError:
            return secrets.token_hex(32)
    return digest.hexdigest()


def _kind(register: Register) -> str:
    bounds = ",".join(f"{low}..{high}" for low, high in register.dims)
    return f"ARRAY[{bounds}] OF {register.type}" if bounds else register.type


class Inputs(Protocol):
    """The values of a model's inputs, by path; None if a value is unknown."""

    @property
    def changed(self) -> Collection[str]:
        """The paths of the inputs whose values have changed since the previous step; in the first step, all paths."""

    def __contains__(self, path: object, /) -> bool: ...

    def __getitem__(self, path: str, /) -> Any: ...


class Source(Protocol):
    """A source for which this program runs the model, such as ``shmio.client.Simulation``."""

    @property
    def source(self) -> str:
        """The name of the source."""

    @property
    def inputs(self) -> Inputs:
        """The values of the model's inputs."""

    @property
    def outputs(self) -> Mapping[str, Any]:
        """The present values of the registers that the model computes."""

    @property
    def computed(self) -> bool:
        """True if a model has computed these outputs; False if they are initial values."""


class ServedModel:
    """Runs a model in a client, for a source with ``connector = "remote"``.

    Pass its ``step`` and ``start`` to :meth:`shmio.client.Client.simulate`. The model behaves as
    with ``connector = "simulation"``. Before its first step, the model continues from the values
    that an earlier model has computed.
    """

    def __init__(self, model: type[Model], parameters: Mapping[str, object] = NOTHING, seed: int = 0) -> None:
        """Create the model.

        Args:
            model: The model's class.
            parameters: Values of parameters, by name.
            seed: The seed of the model's randomness.

        Raises:
            ConfigError: A parameter is unknown, or its value does not fit.

        """
        self._runner = ModelRunner(model, None, parameters, seed)
        layout = self._runner.layout
        self._outputs = [(register, codec(register, layout.byte_order)) for register in self._runner.computed]
        self._bytes = _OutputBytes(self._runner.computed)
        self._inputs = frozenset(self._runner.inputs)
        self._begun = False
        self._new: dict[str, None] = {}  # changed inputs that the model has not seen yet
        self._sent: bytes | None = None

    def start(self, joined: Source) -> None:
        """Check that the source has the model's registers. Call this after each connect.

        Before its first step, the model continues from the source's values, if a model has computed
        them.

        Args:
            joined: The source.

        Raises:
            ModelError: The source lacks a register that the model declares.

        """
        for path in self._runner.inputs:
            if path not in joined.inputs:
                raise ModelError(self._lacks(path, joined, "sends to its model", "leave it out of outputs"))
        for register, _ in self._outputs:
            if register.path not in joined.outputs:
                key = "inouts" if register.path in self._inputs else "outputs"
                raise ModelError(self._lacks(register.path, joined, "receives from its model", f"name it in {key}"))
        if not self._begun and joined.computed:
            image = bytearray(self._runner.image)
            for register, encoder in self._outputs:
                value = joined.outputs[register.path]
                if value is not None:
                    encoder.encode_into(_plain(value), image)
            self._runner.resume(bytes(image))

    def step(self, time_s: float, dt_s: float, inputs: Inputs) -> dict[str, object]:
        """Compute a step with the model.

        Args:
            time_s: The simulation time at the end of the step, in s.
            dt_s: The length of the step, in s.
            inputs: The values of the inputs.

        Returns:
            The outputs that have changed, by path.

        Raises:
            ModelError: The model's code failed.

        """
        self._new.update(dict.fromkeys(path for path in inputs.changed if path in self._inputs))
        self._runner.connect({path: value for path in self._new if (value := inputs[path]) is not None})
        self._new.clear()
        image = self._runner.step(round(time_s * 1e9), round(dt_s * 1e9))
        self._begun = True  # set only after a successful step: a failed one has no values to continue from
        outputs = dict(self._changes(image))
        self._sent = image
        return outputs

    def _changes(self, image: bytes) -> Iterator[tuple[str, object]]:
        before = self._sent
        for index in range(len(self._outputs)) if before is None else self._bytes.differing(image, before):
            register, decoder = self._outputs[index]
            yield register.path, decoder.decode(image)

    def _lacks(self, path: str, joined: Source, what: str, remedy: str) -> str:
        return (
            f"model {self._runner.name}: {path} is not a register that {joined.source} {what}; in the configuration of "
            f"the instance, add it to the layout or {remedy}"
        )


class _OutputBytes:
    """The bytes of a model's outputs in an image. In the layout of the declarations, no registers share a byte."""

    def __init__(self, registers: Sequence[Register]) -> None:
        self._owners = np.repeat(np.arange(len(registers)), [register.size for register in registers])
        within = [np.arange(register.offset, register.offset + register.size) for register in registers]
        self._bytes = np.concatenate([np.zeros(0, np.intp), *within])

    def differing(self, one: bytes, other: bytes) -> list[int]:
        """Return the ascending indices of the outputs that differ between two images."""
        differ = (np.frombuffer(one, np.uint8) != np.frombuffer(other, np.uint8))[self._bytes]
        found: list[int] = np.unique(self._owners[differ]).tolist()
        return found


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value
