"""A model's class that a client's ``simulate`` runs. It gives the same bytes as within the instance."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from shmio.errors import ConfigError, ModelError
from shmio.layout.values.codec import codec
from shmio.simulation import Input, Model, ModelRunner, Output, ServedModel
from tests.unit.simulation.plant import Belt

MS = 1_000_000


class Given(Mapping[str, Any]):
    """Inputs as a client receives them."""

    def __init__(self, values: Mapping[str, Any], changed: Collection[str] = ()) -> None:
        self._values = values
        self.changed = changed

    def __getitem__(self, path: str) -> Any:
        return self._values[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


class Joined:
    """A source that the model has joined, whose registers have these values."""

    source = "belt"

    def __init__(self, inputs: Mapping[str, Any], outputs: Mapping[str, Any], *, computed: bool = False) -> None:
        self.inputs = Given(inputs)
        self.outputs = outputs
        self.computed = computed


def values(runner: ModelRunner, image: bytes) -> dict[str, Any]:
    layout = runner.layout
    return {register.path: codec(register, layout.byte_order).decode(image) for register in layout.registers}


def split(every: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the inputs and the outputs among a belt's values."""
    both = {"drives/main", "raw"}
    inputs = {"speed", "stop"} | both
    return (
        {path: value for path, value in every.items() if path in inputs},
        {path: value for path, value in every.items() if path not in inputs or path in both},
    )


def test_a_served_model_gives_the_same_values_as_in_the_instance() -> None:
    local = ModelRunner(Belt, parameters={"noise_m": 0.5}, seed=7)
    served = ServedModel(Belt, {"noise_m": 0.5}, 7)
    inputs, outputs = split(values(local, local.begin()))
    served.start(Joined(inputs, dict.fromkeys(outputs)))
    known: dict[str, Any] = {}
    for number in range(1, 30):
        changed = inputs if number == 1 else {}
        if number == 5:
            changed = {"speed": np.float32(0.25), "raw": np.array([9, 8, 7, 6], np.int32), "drives/main": 12}
            inputs |= changed
        local.connect({path: value.tolist() if hasattr(value, "tolist") else value for path, value in changed.items()})
        image = local.step(number * 20 * MS, 20 * MS)
        given = served.step(number * 0.02, 0.02, Given(inputs, tuple(changed)))
        assert all(known.get(path) != value for path, value in given.items()), "only changed outputs"
        known |= given
        assert known == split(values(local, image))[1]
    assert set(known) == set(outputs)


def test_a_served_model_continues_from_the_sources_values() -> None:
    runner = ModelRunner(Belt)
    inputs, outputs = split(values(runner, runner.begin()))
    served = ServedModel(Belt)
    served.start(Joined(inputs, outputs | {"position": np.float64(1.5), "label": None}, computed=True))
    given = served.step(0.1, 0.1, Given(inputs, tuple(inputs)))
    assert given["position"] == pytest.approx(1.55)
    served.start(Joined(inputs, outputs, computed=True))  # the connection was lost and the model has rejoined
    assert served.step(0.2, 0.1, Given(inputs))["position"] == pytest.approx(1.6)


def test_a_source_that_was_never_computed_starts_with_the_models_initial_values() -> None:
    class Counter(Model):
        start_at = Output("INT", 5)

        def step(self, time_s: float, dt_s: float) -> None:
            self.start_at += 1

    served = ServedModel(Counter)
    served.start(Joined({}, {"start_at": 0}))
    assert served.step(1.0, 1.0, Given({})) == {"start_at": 6}


def test_a_model_without_a_successful_step_continues_from_another_models_values() -> None:
    class Counter(Model):
        count = Output("INT", 5)

        def step(self, time_s: float, dt_s: float) -> None:
            if time_s == 1.0:
                raise ValueError("not yet")
            self.count += 1

    served = ServedModel(Counter)
    served.start(Joined({}, {"count": 0}))
    with pytest.raises(ModelError, match="not yet"):
        served.step(1.0, 1.0, Given({}))
    served.start(Joined({}, {"count": 70}, computed=True))
    assert served.step(2.0, 1.0, Given({})) == {"count": 71}


def test_invalid_inputs_are_ignored_and_inputs_of_a_failed_step_are_kept() -> None:
    class Fragile(Model):
        number = Input("INT", 1)
        shown = Output("INT")

        def step(self, time_s: float, dt_s: float) -> None:
            if time_s == 2.0:
                raise ZeroDivisionError("no")
            self.shown = self.number

    served = ServedModel(Fragile)
    served.start(Joined({"number": 0}, {"shown": 0}))
    assert served.step(1.0, 1.0, Given({"number": None}, ("number",))) == {"shown": 1}
    with pytest.raises(ModelError, match=r"ZeroDivisionError: no \(test_runner_served.py, line"):
        served.step(2.0, 1.0, Given({"number": 7}, ("number",)))
    assert served.step(3.0, 1.0, Given({"number": 7})) == {"shown": 7}


@pytest.mark.parametrize(
    ("lacking", "message"),
    [
        ("speed", "speed is not a register that belt sends to its model; in the configuration of the instance"),
        ("position", "position is not a register that belt receives from its model; .* or name it in outputs"),
        ("drives/main", "drives/main is not a register that belt sends to its model"),
    ],
)
def test_a_source_that_lacks_a_register_is_named(lacking: str, message: str) -> None:
    runner = ModelRunner(Belt)
    inputs, outputs = split(values(runner, runner.begin()))
    inputs.pop(lacking, None)
    outputs.pop(lacking, None)
    with pytest.raises(ModelError, match=message):
        ServedModel(Belt).start(Joined(inputs, outputs))


def test_an_in_out_that_is_missing_in_the_configuration_is_named() -> None:
    runner = ModelRunner(Belt)
    inputs, outputs = split(values(runner, runner.begin()))
    del outputs["raw"]
    with pytest.raises(ModelError, match="raw is not a register that belt receives from its model; in the"):
        ServedModel(Belt).start(Joined(inputs, outputs))


def test_parameters_are_checked() -> None:
    with pytest.raises(ConfigError, match=r"parameters\.weight: unknown parameter 'weight' of model Belt"):
        ServedModel(Belt, {"weight": 3})
