from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from shmio.errors import ModelError
from shmio.layout.topic import find
from shmio.simulation import InOut, Input, Model, Output, Parameter, layout_of
from shmio.simulation.model import Declaration
from tests.unit.simulation.plant import Belt


class Still(Model):
    """A model that computes nothing."""

    def step(self, time_s: float, dt_s: float) -> None: ...


def test_the_layout_has_the_declared_registers_in_their_order() -> None:
    layout = layout_of(Belt)
    assert (layout.name, layout.byte_order) == ("Belt", "little")
    assert [(r.path, r.type, r.dims, r.initial) for r in layout.registers] == [
        ("speed", "REAL", (), "0.5"),
        ("stop", "BOOL", (), None),
        ("position", "LREAL", (), None),
        ("barriers", "BOOL", ((1, 3),), None),
        ("label", "STRING[12]", (), "'empty'"),
        ("drives/main", "INT", (), "7"),
        ("raw", "BYTE", ((0, 3),), "[1, 2, 3, 4]"),
        ("parts/box/width", "REAL", (), "0.25"),
        ("parts/box/corners", "INT", ((0, 1),), None),
    ]
    assert find(layout, "speed").comment == "of the belt [m/s]"


def test_paths_may_have_dots_and_slashes() -> None:
    class Robot(Still):
        link = Output("LREAL", path="joints/R3200/Link1/R/position")
        axis = Output("LREAL", path="joints/Kuka.j1/R")

    assert [r.path for r in layout_of(Robot).registers] == ["joints/R3200/Link1/R/position", "joints/Kuka.j1/R"]


def test_a_structure_of_known_shape_is_its_members() -> None:
    class Zone(Still):
        zone = InOut("SafetyZone", path="safetyzones/Z1")

    assert [(r.path, r.type) for r in layout_of(Zone).registers] == [
        ("safetyzones/Z1/header/seq", "UDINT"),
        ("safetyzones/Z1/header/stamp/sec", "ULINT"),
        ("safetyzones/Z1/header/stamp/nsec", "ULINT"),
        ("safetyzones/Z1/header/frame_id", "STRING[80]"),
        ("safetyzones/Z1/zone", "STRING[80]"),
        ("safetyzones/Z1/level", "REAL"),
        ("safetyzones/Z1/object1", "STRING[80]"),
        ("safetyzones/Z1/object2", "STRING[80]"),
    ]


def test_a_subclass_has_the_registers_of_the_class_above() -> None:
    class Base(Still):
        a = Input("INT")
        b = Input("INT")

    class Above(Base):
        b = Output("REAL")
        c = Output("INT")

    assert [(r.path, r.type) for r in layout_of(Above).registers] == [("a", "INT"), ("b", "REAL"), ("c", "INT")]
    assert len(layout_of(Base).registers) == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Input("RAEL"), "speed: unknown type 'RAEL'"),
        (lambda: Output("ARRAY[3..1] OF INT"), "speed: expected bounds as in"),
        (lambda: Output("INT", 70_000), "speed: INT: 70000 is out of range"),
        (lambda: Output("INT", "fast"), "speed: INT: expected a literal such as 0, found 'fast'"),
        (lambda: Output("ARRAY[0..1] OF INT", [1, 2, 3]), "speed: initial: expected at most 2 values, found more"),
        (lambda: Input("INT", path="axis/in"), "axis/in: leave out /in or /out at the end of the path"),
        (lambda: Input("INT", path="a//b"), "a//b: the path has an empty segment"),
        (lambda: Input("INT", path="first"), "speed: the path 'first' is used twice"),
        (lambda: Input("INT", path="first/second"), "first/second: first is already a register"),
        (lambda: Input({"a": "INT"}, {"b": 1}), "speed: initial: expected a dict with some of a, found {'b': 1}"),
        (lambda: InOut("JointTrajectory[6]"), "speed: expected JointTrajectory[joints, points] with at most 64 joints"),
        (lambda: Parameter("RAEL"), "speed: unknown type 'RAEL'"),
        (
            lambda: Parameter(cast("Any", 1.0)),
            "speed: type: expected a type such as 'LREAL', or a dict with the types of the members, found 1.0; ",
        ),
        (lambda: InOut(cast("Any", None)), "speed: type: expected a type such as 'LREAL'"),
        (lambda: Input("RAEL", limits=(0, 1)), "speed: unknown type 'RAEL'"),
        (lambda: Output("INT", limits=(0, 1)), "speed: limits: an output has no limits"),
        (lambda: Input("BOOL", limits=(0, 1)), "speed: limits: only a number or an array of numbers"),
        (lambda: InOut({"a": "INT"}, limits=(0, 1)), "speed: limits: only a number or an array of numbers"),
        (lambda: Input("INT", limits=(2, 1)), "speed: limits: expected the lowest and the highest value"),
    ],
)
def test_an_invalid_declaration_is_refused_and_named(make: Callable[[], Declaration], message: str) -> None:
    with pytest.raises(ModelError) as caught:
        type("Wrong", (Still,), {"first": Input("INT"), "speed": make()})
    assert str(caught.value).startswith("model Wrong: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_several_faults_are_reported_together() -> None:
    with pytest.raises(ModelError, match=r"model Wrong: a: unknown type 'X'.*; b: unknown type 'Y'"):
        type("Wrong", (Still,), {"a": Input("X"), "b": Input("Y")})


@pytest.mark.parametrize("name", ["step", "start", "random", "_hidden"])
def test_names_of_model_attributes_cannot_be_registers(name: str) -> None:
    with pytest.raises(ModelError, match=f"model Wrong: {name}: this name is reserved"):
        type("Wrong", (Still,), {name: Input("INT")})


def test_a_model_must_not_define_init() -> None:
    with pytest.raises(ModelError, match=r"model Wrong: a model cannot have its own __init__; use start\(\)"):
        type("Wrong", (Still,), {"__init__": lambda self: None})


def test_a_model_without_registers_has_no_layout() -> None:
    with pytest.raises(ModelError, match="model Still declares no register"):
        layout_of(Still)
