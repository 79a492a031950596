"""The process of one emulated device."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor, wait

from shmio import worker
from shmio.config import Address
from shmio.emulators.device import Served
from shmio.emulators.kinds import create
from shmio.errors import ShmioError
from shmio.layout.document import load_layout
from shmio.logs import fields
from shmio.worker import BEAT_S, Worker


def run(worker: Worker) -> None:
    """Run the emulator until a stop is requested.

    The process description contains the compiled layouts, and the keys of the sources that read
    them.
    """
    config = worker.config
    layouts = [load_layout(layout.encode()) for layout in config["layouts"]]
    served = [Served(layout, options) for layout, options in zip(layouts, config["options"], strict=True)]
    listen = Address.parse(config["listen"])
    device = create(config["kind"], served, config["program"], listen, db_number=config["dbNumber"])
    with ThreadPoolExecutor(1) as pool:  # some libraries take seconds, during which the heartbeat continues
        starting = pool.submit(device.start)
        while not wait((starting,), BEAT_S).done:
            worker.report()
    try:
        starting.result()
        worker.log.info("playing %s", config["program"], extra=fields(address=listen))
        worker.running()
        while not worker.stopping.wait(BEAT_S):
            cycle = device.cycle
            if cycle.failure is not None:
                raise ShmioError(f"program {config['program']} failed: {cycle.failure}") from cycle.failure
            worker.report((cycle.cycles, cycle.overruns))
    finally:
        device.stop()


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
