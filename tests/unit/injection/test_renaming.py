"""A declaration that names sources as another instance does."""

from __future__ import annotations

import pytest

from shmio.config import Declaration
from shmio.errors import ConfigError
from shmio.injection.renaming import renamed

NAMES = {"far": "cell", "other": "plc"}


def declaration(target: str | list[str], when: str | None = None) -> Declaration:
    return Declaration(name="one", target=target, operation="freeze", when=when)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("far/Robot_800/Axs1_Pos", "cell/Robot_800/Axs1_Pos"),
        ("far/Robot_*/**/in", "cell/Robot_*/**/in"),
        ("far", "cell"),
        ("FAR://a/b", "cell/a/b"),
        ("count", "cell/count"),
        ("count/in", "cell/count/in"),
        ("model/clock", "model/clock"),
    ],
)
def test_paths_get_the_new_name_of_their_source(text: str, expected: str) -> None:
    assert renamed(declaration(text), NAMES, "far").target == expected
    assert renamed(declaration([text]), NAMES, "far").target == [expected]


def test_conditions_get_the_new_names() -> None:
    when = "far/a > 5 and not ('other/b c' = 2) or rising(far/a >= 1.5e3) and third/x"
    found = renamed(declaration("far/a", when), NAMES).when
    assert found == '"cell/a" > 5 and not ("plc/b c" = 2) or rising("cell/a" >= 1.5e3) and third/x'


def test_names_that_are_equal_leave_the_text_unchanged() -> None:
    same = declaration("FAR://a", "FAR://a = 1")
    assert renamed(same, {"far": "far"}) is same


def test_a_condition_with_a_fault_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"^when: "):
        renamed(declaration("far/a", "far/a >"), NAMES)
