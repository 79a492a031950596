"""Runs a model for an instance elsewhere, as connector "simulation" runs it here."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, Protocol

from shmio.errors import ModelError
from shmio.layout.values.codec import codec
from shmio.layout.values.write import bits_of
from shmio.simulation.model import Model
from shmio.simulation.runner import NOTHING, ModelRunner


class Inputs(Protocol):
    """The values of inputs, by the registers' paths; None if there is no value."""

    @property
    def changed(self) -> Collection[str]:
        """The paths of the values that have changed."""

    def __contains__(self, path: object, /) -> bool: ...

    def __getitem__(self, path: str, /) -> Any: ...


class Source(Protocol):
    """A source that a program has joined, such as ``shmio.client.Simulation``."""

    @property
    def source(self) -> str:
        """The name of the source."""

    @property
    def inputs(self) -> Inputs:
        """The values for the model."""

    @property
    def outputs(self) -> Mapping[str, Any]:
        """The present values of the registers that the model computes."""

    @property
    def computed(self) -> bool:
        """Whether a model has computed the outputs already."""


class ServedModel:
    """Computes a source of connector "remote".

    :meth:`shmio.client.Client.simulate` takes its ``step`` and ``start``. It continues from what
    the source shows, like a model in a restarted process.
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
        self._outputs = [
            (register, codec(register, layout.byte_order), bits_of(register)) for register in self._runner.computed
        ]
        self._inputs = frozenset(self._runner.inputs)
        self._begun = False
        self._new: dict[str, None] = {}  # changed inputs that the model has not seen yet
        self._sent: bytes | None = None

    def start(self, joined: Source) -> None:
        """Take the present state of the source, each time it is joined.

        Args:
            joined: The source.

        Raises:
            ModelError: The source lacks a register of the model.

        """
        for path in self._runner.inputs:
            if path not in joined.inputs:
                raise ModelError(self._lacks(path, joined, "gives to its model", "leave it out of outputs"))
        for register, _, _ in self._outputs:
            if register.path not in joined.outputs:
                key = "inouts" if register.path in self._inputs else "outputs"
                raise ModelError(self._lacks(register.path, joined, "has from its model", f"name it in {key}"))
        if not self._begun and joined.computed:
            image = bytearray(self._runner.image)
            for register, encoder, _ in self._outputs:
                value = joined.outputs[register.path]
                if value is not None:
                    encoder.encode_into(_plain(value), image)
            self._runner.resume(bytes(image))

    def step(self, time_s: float, dt_s: float, inputs: Inputs) -> dict[str, object]:
        """Have the model compute a step.

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
        self._begun = True  # a failed step computes nothing to continue from
        outputs = dict(self._changes(image))
        self._sent = image
        return outputs

    def _changes(self, image: bytes) -> Iterator[tuple[str, object]]:
        before = self._sent
        for register, decoder, bits in self._outputs:
            where = slice(register.offset, register.offset + register.size)
            if before is None or _differ(image[where], before[where], bits):
                yield register.path, decoder.decode(image)

    def _lacks(self, path: str, joined: Source, what: str, remedy: str) -> str:
        return (
            f"model {self._runner.name}: {path} is not a register that {joined.source} {what}: in the configuration of "
            f"the instance, add it to the layout or {remedy}"
        )


def _differ(one: bytes, other: bytes, bits: bytes) -> bool:
    return one != other and any((a ^ b) & own for a, b, own in zip(one, other, bits, strict=True))


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value
