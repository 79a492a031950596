"""``shmio-supervisor emulator``: changes how an emulator answers its clients."""

from __future__ import annotations

import argparse
from typing import Final

from shmio import control
from shmio.cli.target import target
from shmio.errors import ControlError, UnreachableError
from shmio.segment import Segment
from shmio.wording import unknown

ANSWER_S: Final = 10.0
DELAY_MS: Final = 100.0


def emulator(arguments: argparse.Namespace) -> int:
    """Set how an emulator answers its clients from now on."""
    name, answers = arguments.name, arguments.answers
    delay_ms = (arguments.delay_ms or DELAY_MS) if answers == "delay" else 0.0
    with target(arguments).open_supervised() as segment:
        disturb(segment, name, answers, delay_ms)
    print(f"{name}: {answers}" + (f" {delay_ms:g} ms" if delay_ms else ""))
    return 0


def disturb(segment: Segment, name: str, answers: control.Answers, delay_ms: float) -> None:
    """Set how an emulator of an instance answers its clients from now on.

    Args:
        segment: The instance's segment.
        name: Name of the emulator.
        answers: How it answers; ``ok`` ends all faults.
        delay_ms: For ``delay``, the delay of each answer, in ms.

    Raises:
        ControlError: There is no such emulator, or it cannot be disturbed.

    """
    segment.refresh()
    emulators = [slot.name for slot in segment.processes if slot.kind == "emulator"]
    if name not in emulators:
        raise ControlError(unknown("emulator", name, emulators))
    try:
        control.request(
            control.emulator_socket_path(segment.header.control, name), control.Disturb(answers, delay_ms), ANSWER_S
        )
    except UnreachableError:
        raise ControlError(
            f"emulator {name!r} cannot be disturbed: it is not running, or its section has no faults = true"
        ) from None
