"""The kinds of emulators, and how each of them is created."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Final

from shmio.config.address import Address
from shmio.emulators.device import Device, Served
from shmio.emulators.programs import BUILT_IN, UserCode
from shmio.errors import ConfigError

S7: Final = "s7"
KINDS: Final = (S7, "modbus", "opcua")
"""The kinds of emulators. Each kind has the name of the connector that can read it."""
FAULTY: Final = (S7, "modbus")
"""The kinds of emulators that can misbehave on command."""
_LIBRARIES: Final = {"modbus": "pymodbus", "opcua": "asyncua"}
_EXTRA: Final = "kind: the emulator {kind} needs another library; run pip install 'shmio[{kind}]'"


def create(
    kind: str,
    served: Sequence[Served],
    program: str,
    listen: Address,
    *,
    db_number: int | None = None,
    profile: str | None = None,
    code: UserCode = BUILT_IN,
) -> Device:
    """Create an emulator without starting it.

    Args:
        kind: One of ``KINDS``.
        served: The layouts to serve, at least one; the program runs on the first.
        program: The program to run.
        listen: The address to listen on.
        db_number: For S7, the number of the first layout's block; None: the number in the layout.
        profile: For S7, the name of the kind of CPU whose times and limits the emulator has.
        code: Folder and parameters of the program if it is a class of the user.

    Raises:
        ConfigError: The library is missing, there is no such profile or program, or a layout does
            not suit it.

    """
    # Each kind is imported where it is used, because a process has only one.
    if kind == S7:
        from shmio.emulators.emulator import Emulator  # noqa: PLC0415
        from shmio.emulators.s7 import ServerOptions  # noqa: PLC0415

        layouts = [one.layout for one in served]
        options = None if profile is None else ServerOptions.of(profile)
        return Emulator(
            layouts[0], program, listen, db_number=db_number, others=layouts[1:], options=options, code=code
        )
    if profile is not None:
        raise ConfigError(f"profile: only emulators of kind {S7} have profiles; leave out this key")
    if importlib.util.find_spec(_LIBRARIES[kind]) is None:
        raise ConfigError(_EXTRA.format(kind=kind))
    if kind == "modbus":
        from shmio.emulators.modbus import ModbusEmulator  # noqa: PLC0415

        return ModbusEmulator(served, program, listen, code=code)
    from shmio.emulators.opcua import OpcUaEmulator  # noqa: PLC0415

    return OpcUaEmulator(served, program, listen, code=code)
