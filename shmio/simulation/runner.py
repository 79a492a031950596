"""Runs a model on the images of its block."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final

from shmio.errors import ConfigError, LayoutError, ModelError, PathError, ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout, Register
from shmio.layout.topic import find
from shmio.layout.values.write import Write
from shmio.simulation.declarations import Declaration, InOut, Input, Output, Parameter, place_declarations
from shmio.simulation.failure import explain
from shmio.simulation.images import Images
from shmio.simulation.model import Model, declared, layout_of
from shmio.simulation.ports import Ends, Port, RegisterPort, port_of

NOTHING: Final[Mapping[str, object]] = MappingProxyType({})


class ModelRunner:
    """One model at work. Not for several threads at once.

    It keeps two images of the block: what is commanded, which is what others have written to inputs, to the ``/in`` of
    in-out registers and to registers that the model does not know; and what is shown. Inputs and unknown registers are
    shown as they are commanded, from the next step on.
    """

    def __init__(
        self,
        model: type[Model],
        layout: Layout | None = None,
        parameters: Mapping[str, object] = NOTHING,
        seed: int = 0,
    ) -> None:
        """``layout``: one that has the declared registers, and maybe more; default: that of the declarations.

        ``parameters``: values by the parameters' names. ConfigError, beginning with the key: the layout has not the
        registers, there is no such parameter, or its value does not fit.
        """
        self.name = f"{model.__module__}:{model.__qualname__}"
        self.layout = layout_of(model) if layout is None else layout
        found = {declaration: self._find(model, declaration) for declaration in declared(model, Input, Output, InOut)}
        outputs = [r for declaration in found if isinstance(declaration, Output) for r in found[declaration].values()]
        both = [r for declaration in found if isinstance(declaration, InOut) for r in found[declaration].values()]
        self._images = Images(self.layout, outputs, both)
        self.computed = (*outputs, *both)
        """The registers whose shown values the model computes."""
        self._inputs: dict[str, RegisterPort] = {}
        ports: dict[str, Port] = _parameters(model, parameters)
        ends: dict[str, Ends] = {}
        order = self.layout.byte_order
        for declaration, registers in found.items():
            commanded, shown = (
                port_of(declaration.path, registers, order, image)
                for image in (self._images.commanded, self._images.shown)
            )
            if isinstance(declaration, Output):
                ports[declaration.name] = shown
                continue
            self._inputs |= {r.path: RegisterPort(r, order, self._images.commanded) for r in registers.values()}
            if isinstance(declaration, InOut):
                ends[declaration.name] = Ends(commanded, shown)
            else:
                ports[declaration.name] = commanded
        self._model = model(ports, ends, seed)
        self._started = False

    @property
    def inputs(self) -> tuple[str, ...]:
        """Paths that :meth:`connect` takes."""
        return tuple(self._inputs)

    @property
    def image(self) -> bytes:
        """The whole block as it is shown."""
        return bytes(self._images.shown)

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Command these bytes and bits, for the next step; of each "" or why it is refused: the model computes it."""
        return self._images.write(writes)

    def connect(self, values: Mapping[str, object]) -> None:
        """Command values of inputs by their paths; an input that is left out keeps what it has.

        PathError: there is no such input; ValueRangeError: the value does not fit. Those before it are commanded.
        """
        for path, value in values.items():
            port = self._inputs.get(path)
            if port is None:
                there = ", ".join(self._inputs) or "none"
                raise PathError(f"model {self.name} has no input {path}; there are: {there}")
            port.write(value)

    def begin(self) -> bytes:
        """Start the model, unless it is; return the image before the first step. ModelError: its code failed."""
        if not self._started:
            self._run(self._model.start)
            self._started = True
        return self.image

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Compute the image at ``time_ns``, ``dt_ns`` after the one before.

        ModelError: the model's code failed, and the image is still the one before.
        """
        if not self._started:
            self.begin()
        before = self.image
        self._images.shown[:] = self._images.with_given(before)
        self._run(self._model.step, time_ns / 1e9, dt_ns / 1e9, instead=before)
        return self.image

    def resume(self, image: bytes) -> None:
        """Go on from an image: it is what is shown, and what is commanded. LayoutError: it has another size."""
        try:
            self._images.resume(image)
        except LayoutError as error:
            raise LayoutError(f"model {self.name}: {error}") from None

    def _run(self, call: Callable[..., None], *arguments: float, instead: bytes | None = None) -> None:
        """Call the model's code; what it had computed when it failed is not shown."""
        before = self.image if instead is None else instead
        try:
            call(*arguments)
        except (Exception, SystemExit) as error:
            self._images.shown[:] = before
            raise ModelError(f"model {self.name}: {explain(error, self._model.__module__)}") from error

    def _find(self, model: type[Model], declaration: Declaration) -> dict[str, Register]:
        """The registers of a declaration, by their paths in it; ConfigError: the layout has none, or others."""
        found: dict[str, Register] = {}
        for member, path in declaration.paths.items():
            own = find(layout_of(model), path)
            try:
                register = found[member] = find(self.layout, path)
            except PathError as error:
                raise ConfigError(f"layout: model {self.name} needs a register {path}, {_kind(own)}: {error}") from None
            if (register.type, register.dims) != (own.type, own.dims):
                raise ConfigError(
                    f"layout: model {self.name} needs {path} as {_kind(own)}; in {self.layout.name} it is "
                    f"{_kind(register)}"
                )
        return found


def _parameters(model: type[Model], given: Mapping[str, object]) -> dict[str, Port]:
    """What a model's parameters are read from; ConfigError: there is no such one, or the value does not fit."""
    layout = place_declarations(model.__qualname__, declared(model, Parameter))
    values, _ = initial_frame(layout)
    ports: dict[str, Port] = {}
    for declaration in declared(model, Parameter):
        registers = {member: find(layout, path) for member, path in declaration.paths.items()}
        ports[declaration.name] = port_of(declaration.name, registers, layout.byte_order, values)
    for name, value in given.items():
        if name not in ports:
            there = ", ".join(ports) or "none"
            raise ConfigError(
                f"parameters.{name}: model {model.__qualname__} has no such parameter; there are: {there}"
            )
        try:
            ports[name].write(value)
        except ValueRangeError as error:
            raise ConfigError(f"parameters.{error}") from None
    return ports


def _kind(register: Register) -> str:
    bounds = ",".join(f"{low}..{high}" for low, high in register.dims)
    return f"ARRAY[{bounds}] OF {register.type}" if bounds else register.type
