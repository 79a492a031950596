"""The fieldbus: carries the signals of robots and motor to the inputs of the PLC."""

from __future__ import annotations

import logging
import time

import shmio
from shmio.errors import CommandError, NotRunningError
from shmio.model.values import Quality

INSTANCE = "commissioning"
INPUTS = {
    "robot_800/at": "plc/Inputs/Robot_800_At",
    "robot_825/at": "plc/Inputs/Robot_825_At",
    "motor/temperature": "plc/Inputs/Temperature",
}
RESOLUTION = 0.1  # smaller changes of a number are not sent


def carry(cell: shmio.Cell) -> None:
    """Write to the PLC what differs there, whenever a signal changes or the PLC comes back."""
    with cell.subscribe(*INPUTS, *INPUTS.values()) as updates:
        for _ in updates:
            now = {
                reading.path: reading.value
                for reading in cell.get(*INPUTS, *INPUTS.values())
                if reading.quality is Quality.GOOD and isinstance(reading.value, int | float)
            }
            pairs = [(signal, place) for signal, place in INPUTS.items() if signal in now and place in now]
            changed = {place: now[signal] for signal, place in pairs if abs(now[signal] - now[place]) >= RESOLUTION}
            try:
                if changed:
                    cell.set(changed)
            except CommandError as error:
                logging.warning("%s", error)


def main() -> None:
    """Wait for the instance, and carry its signals until it ends."""
    while True:
        try:
            cell = shmio.attach(INSTANCE, writable=True)
        except NotRunningError:
            time.sleep(0.2)
            continue
        try:
            with cell:
                carry(cell)
        except NotRunningError:
            return


if __name__ == "__main__":
    main()
