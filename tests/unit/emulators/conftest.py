"""The printed DB201, as a layout."""

from __future__ import annotations

import pytest

from shmio.layout.model import Layout, Register


@pytest.fixture(scope="session")
def db201() -> Layout:
    """DB201 with the printed names, some of which have a space in place of the underscore."""
    registers = [
        Register("Inputs", "BYTE", ((0, 999),), 0, None, 1000, 1000),
        Register("Outputs", "BYTE", ((0, 1099),), 1000, None, 1100, 1100),
    ]
    names = ["NCAchse1 Pos", "NCAchse2_Pos"]
    for robot, spaced in ((800, (2, 3, 4, 5, 6)), (825, ()), (850, (4, 5))):
        names += [f"Robot_{robot}/Axs{axis}{' ' if axis in spaced else '_'}Pos" for axis in range(1, 7)]
    registers += [Register(name, "REAL", (), 2100 + 4 * place, None, 4, 1) for place, name in enumerate(names)]
    return Layout("DB201", 201, 2180, False, tuple(registers))
