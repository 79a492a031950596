from __future__ import annotations

from collections.abc import Sequence

import pytest

from shmio.errors import LayoutError, ValueRangeError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Register
from shmio.layout.simlog_structures import CONTENTS, members, recognise
from shmio.layout.tags import place_tags

LENGTHS = {"JointTrajectoryPoint": "[6]", "JointTrajectory": "[6, 3]"}


def block(body: str) -> Sequence[Register]:
    source = f"DATA_BLOCK DB1 STRUCT z : Struct {body} END_STRUCT; END_STRUCT; BEGIN END_DATA_BLOCK"
    (layout,) = compile_sources([Source("x.db", source.encode())]).layouts
    registers: Sequence[Register] = layout.registers
    return registers


@pytest.mark.parametrize("shape", CONTENTS)
def test_every_structure_is_a_type_of_tag_tables_and_is_recognised(shape: str) -> None:
    layout = place_tags("t", {"zones/Z1": f"{shape}{LENGTHS.get(shape, '')}"})
    assert layout.registers
    found = recognise("zones/Z1", layout.registers)
    assert found is not None
    assert found[0] == shape
    assert recognise("zones", layout.registers) is None


def test_trajectory_has_the_declared_joints_and_points() -> None:
    inside = members("JointTrajectory[2, 3]")
    assert inside is not None
    assert inside["joint_names"] == "ARRAY[0..1] OF STRING[80]"
    assert inside["points/2/effort"] == "ARRAY[0..1] OF REAL"
    assert inside["points/2/time_from_start/msec"] == "ULINT"
    assert len(inside) == 5 + 3 * 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("JointTrajectory", r"expected JointTrajectory\[joints, points\] with at most 64 joints and 512 points, found"),
        ("JointTrajectory[6]", "found JointTrajectory"),
        ("JointTrajectory[6, 513]", "found JointTrajectory"),
        ("JointTrajectoryPoint[0]", r"expected JointTrajectoryPoint\[joints\] with at most 64 joints, found"),
        ("JointTrajectoryPoint[-1]", "found JointTrajectoryPoint"),
        ("SafetyZone[3]", r"expected SafetyZone, found SafetyZone\[3\]"),
        ("Point[]", r"expected Point, found Point\[\]"),
    ],
)
def test_wrong_lengths_are_refused(text: str, message: str) -> None:
    with pytest.raises(ValueRangeError, match=message):
        members(text)


@pytest.mark.parametrize("text", ["LREAL", "STRING[20]", "time", "Pose", "ARRAY[0..1] OF Point"])
def test_other_types_are_no_structures(text: str) -> None:
    assert members(text) is None


def test_members_are_recognised_in_any_order_and_case() -> None:
    body = "Zone : String; LEVEL : LReal; Object2 : String[8]; object1 : WString;"
    found = recognise("z", block(body))
    assert found is not None
    assert found[0] == "SafetyZone"
    assert list(found[1]) == ["zone", "level", "object1", "object2"]


@pytest.mark.parametrize(
    "body",
    [
        "x : Real; y : Real;",
        "x : Real; y : Real; z : Int;",
        "x : Real; y : Real; z : Real; v : Real;",
        "x : Real; y : Real; z : Array[0..1] of Real;",
        "x : Real; y : Real; z : Struct z : Real; END_STRUCT;",
        "zone : String; level : Real; object1 : String; object2 : Int;",
        "joint_names : Array[0..1] of String; points : Array[0..1] of Struct x : Real; END_STRUCT;",
        "joint_names : Array[0..1] of String; points : Struct positions : Array[0..1] of Real; END_STRUCT;",
    ],
)
def test_missing_or_additional_member_prevents_recognition(body: str) -> None:
    assert recognise("z", block(body)) is None


def test_arrays_of_structures_come_in_their_order() -> None:
    points = "Array[8..11] of Struct positions : Array[1..2] of Real; END_STRUCT"
    body = f"joint_names : Array[1..2] of String; points : {points};"
    found = recognise("z", block(body))
    assert found is not None
    inside = found[1]["points"]
    assert isinstance(inside, list)
    assert [point["positions"].path for point in inside] == [f"z/points/{index}/positions" for index in (8, 9, 10, 11)]


def test_a_table_cannot_hide_more_registers_than_a_block_may_have() -> None:
    with pytest.raises(LayoutError, match="there are more than 100000 registers, with the members of structures"):
        place_tags("t", {f"t{index}": "JointTrajectory[1, 512]" for index in range(100)})


@pytest.mark.parametrize("key", ["a/in", "out"])
def test_path_of_a_structure_must_not_end_in_a_direction(key: str) -> None:
    with pytest.raises(LayoutError, match=f"{key}: leave out /in or /out at the end"):
        place_tags("t", {key: "Point"})


def test_a_structure_has_no_initial_value_of_its_own() -> None:
    with pytest.raises(LayoutError, match="p: initial: a structure has no initial value"):
        place_tags("t", {"p": {"type": "Point", "initial": 1}})
