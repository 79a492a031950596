"""``shmio-supervisor emulator``: changes how an emulator answers its clients."""

from __future__ import annotations

import argparse
from typing import Final

from shmio import control
from shmio.cli.target import target
from shmio.errors import ControlError, UnreachableError
from shmio.wording import unknown

ANSWER_S: Final = 10.0
DELAY_MS: Final = 100.0


def emulator(arguments: argparse.Namespace) -> int:
    """Set how an emulator answers its clients from now on."""
    name, answers = arguments.name, arguments.answers
    delay_ms = (arguments.delay_ms or DELAY_MS) if answers == "delay" else 0.0
    with target(arguments).open_supervised() as segment:
        kinds = {slot.name: slot.kind for slot in segment.processes}
        emulators = [one for one, kind in kinds.items() if kind == "emulator"]
        path = control.emulator_socket_path(segment.header.control, name)
    if name not in emulators:
        raise ControlError(unknown("emulator", name, emulators))
    try:
        control.request(path, control.Disturb(answers, delay_ms), ANSWER_S)
    except UnreachableError:
        raise ControlError(
            f"emulator {name!r} cannot be disturbed: it is not running, or its section has no faults = true"
        ) from None
    print(f"{name}: {answers}" + (f" {delay_ms:g} ms" if delay_ms else ""))
    return 0
