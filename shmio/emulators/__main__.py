"""The process of one emulated device."""

from __future__ import annotations

import os
import selectors
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shmio import worker
from shmio.config import Address
from shmio.emulators.device import Device, Served
from shmio.emulators.kinds import S7, create
from shmio.emulators.ports import reserved_port
from shmio.emulators.programs import UserCode, is_user_code
from shmio.emulators.state import DeviceKeeper
from shmio.emulators.stepping import InstanceTime
from shmio.errors import ShmioError
from shmio.layout.document import load_layout
from shmio.libraries import skip_package_code
from shmio.local.state_requests import StateRequests
from shmio.logs import fields
from shmio.segment.doorbell import Relay
from shmio.worker import BEAT_S, Reload, Worker

if TYPE_CHECKING:
    from shmio.emulators.faults import FaultControl


def run(worker: Worker) -> None:
    """Run the emulator until a stop is requested.

    The process description contains the compiled layouts, and the keys of the sources that read
    them.
    """
    config, program = worker.config, worker.config["program"]
    listen, faults = Address.parse(config["listen"]), None
    with ExitStack() as cleanup:
        selector = cleanup.enter_context(selectors.DefaultSelector())
        stop = os.eventfd(0, os.EFD_CLOEXEC)
        cleanup.callback(os.close, stop)
        cleanup.callback(worker.on_stop, lambda: None)
        selector.register(stop, selectors.EVENT_READ, lambda: None)
        if config["faults"]:
            from shmio.emulators.faults import FaultControl  # noqa: PLC0415  few emulators need it

            with reserved_port() as inner:
                device = _started(worker, inner, cleanup)
            faults = FaultControl(worker, selector, config["kind"], inner, listen)
            cleanup.callback(faults.close)
        else:
            device = _started(worker, listen, cleanup)
        if config["clock"] == "instance":
            _follow_clock(worker, device, selector, cleanup, faults)
        woken = threading.Event()
        worker.on_reread(woken.set)
        worker.log.info("the emulator runs the program %s", program, extra=fields(address=listen))
        worker.running()
        worker.on_stop(lambda: os.eventfd_write(stop, 1))
        while not worker.stopping.is_set():
            for key, _ in selector.select(BEAT_S):
                key.data()
            if woken.is_set():
                woken.clear()
                if (changed := worker.revised()) is not None:
                    _change(worker, device, changed, woken)
            if faults is not None:
                faults.expire()
            cycle = device.cycle
            if cycle.failure is not None:
                raise ShmioError(f"program {program} failed: {cycle.failure}") from cycle.failure
            worker.report((cycle.cycles, cycle.overruns))


def _change(worker: Worker, device: Device, config: dict[str, Any], woken: threading.Event) -> None:
    """Serve other layouts once the supervisor permits it. Until then, the device continues as before."""
    served = _served(config)
    if Reload(worker, woken).permitted():
        worker.config = config
        with device.cycle.held():
            _beating(worker, lambda: device.change(served))
    worker.running()


def _follow_clock(
    worker: Worker,
    device: Device,
    selector: selectors.BaseSelector,
    cleanup: ExitStack,
    faults: FaultControl | None,
) -> None:
    """Let the device's program follow the instance's clock, and take part in snapshots."""
    page, slot = worker.segment.clock, worker.slot.index
    relay = Relay(page.slot_bell(slot), "emulator-steps")
    cleanup.callback(relay.join)
    time = InstanceTime(page, slot, device.cycle, worker.report)
    cleanup.callback(time.close)
    config = worker.config
    keeper = DeviceKeeper(
        device, time, config["kind"], config["program"], lambda: faults is not None and faults.disturbs
    )
    requests = StateRequests(page, slot, worker.name, Path(config["snapshots"]), keeper)

    def follow() -> None:
        relay.acknowledge()
        requests.serve()
        time.follow()

    selector.register(relay.descriptor, selectors.EVENT_READ, follow)


def _beating(worker: Worker, call: Callable[[], object]) -> None:
    """Call a function that may take seconds, as with some libraries, while the heartbeat continues."""
    with ThreadPoolExecutor(1) as pool:
        calling = pool.submit(call)
        while not wait((calling,), BEAT_S).done:
            worker.report()
    calling.result()


def _served(config: dict[str, Any]) -> list[Served]:
    layouts = [load_layout(layout.encode()) for layout in config["layouts"]]
    return [Served(layout, options) for layout, options in zip(layouts, config["options"], strict=True)]


def _started(worker: Worker, listen: Address, cleanup: ExitStack) -> Device:
    """Create and start the device. ``cleanup`` will stop it."""
    config: dict[str, Any] = worker.config
    served = _served(config)
    code = UserCode(config["folder"], config["parameters"])
    if config["kind"] == S7 and not is_user_code(config["program"]):
        skip_package_code("snap7")  # else it imports asyncio and more, which takes a third of the time of the start
    device = create(
        config["kind"],
        served,
        config["program"],
        listen,
        db_number=config["dbNumber"],
        profile=config["profile"],
        code=code,
    )
    cleanup.callback(device.stop)
    _beating(worker, device.start)
    return device


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
