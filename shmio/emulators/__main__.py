"""The process of one emulated controller."""

from __future__ import annotations

from shmio import worker
from shmio.config import Address
from shmio.emulators.emulator import Emulator
from shmio.errors import ShmioError
from shmio.layout.document import load_layout
from shmio.logs import fields
from shmio.worker import BEAT_S, Worker


def run(worker: Worker) -> None:
    """Run the emulator until a stop is requested.

    The process description contains the compiled layouts.
    """
    config = worker.config
    first, *others = (load_layout(layout.encode()) for layout in config["layouts"])
    listen = Address.parse(config["listen"])
    emulator = Emulator(first, config["program"], listen, db_number=config["dbNumber"], others=others)
    with emulator:
        worker.log.info("playing %s", worker.config["program"], extra=fields(address=emulator.address))
        worker.running()
        while not worker.stopping.wait(BEAT_S):
            if emulator.failure is not None:
                raise ShmioError(f"program {worker.config['program']} failed: {emulator.failure}") from emulator.failure
            worker.report((emulator.cycles, emulator.overruns))


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
