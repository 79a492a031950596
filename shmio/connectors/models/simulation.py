"""A source whose registers a model computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec

from shmio.connectors.models.computed import Computed
from shmio.errors import ConfigError, ModelError
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.simulation.loading import load
from shmio.simulation.model import layout_of
from shmio.simulation.runner import ModelRunner


class Simulation(Computed):
    """``connector = "simulation"``: runs one model on the instance's clock."""

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Its keys. ``model``: ``package.module:Class``; ``folder``: where modules are that are not installed."""

        model: str
        parameters: dict[str, Any] = {}
        seed: Annotated[int, msgspec.Meta(ge=0)] = 0
        connections: dict[str, str] = {}
        folder: str = "."

    def __init__(self, options: Options, layout: Layout) -> None:
        """ConfigError: there is no such model, or its declarations do not go with the layout or the parameters."""
        self._runner = make(options, layout)
        self._connections = options.connections

    @property
    def connections(self) -> Mapping[str, str]:
        """As configured."""
        return self._connections

    @property
    def inputs(self) -> tuple[str, ...]:
        """As the model declares them."""
        return self._runner.inputs

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:  # noqa: ARG002  no model asks for it
        """Give values to inputs."""
        self._runner.connect(values)

    def resume(self, image: bytes) -> None:
        """Go on from the registers; what else a model knows is gone with its process."""
        self._runner.resume(image)

    def begin(self) -> bytes:
        """Start the model."""
        return self._runner.begin()

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Command registers; outputs refuse."""
        return self._runner.write(writes)

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Have the model compute."""
        return self._runner.step(time_ns, dt_ns)


def make(options: Simulation.Options, layout: Layout | None) -> ModelRunner:
    """The model behind the options, on a layout or on that of its declarations. ConfigError, beginning with the key."""
    try:
        model = load(options.model, options.folder)
        own = layout_of(model) if layout is None else layout
    except (ConfigError, ModelError) as error:
        raise ConfigError(f"model: {error}") from None
    return ModelRunner(model, own, options.parameters, options.seed)
