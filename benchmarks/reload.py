"""Reload: how long a source's values are missing when a reload adds or removes a register.

*kept*: only the tag table changes, so the source keeps its process and its connection. *restarted*: the time-out
changes, too, so that the process starts again and connects. The gap is the time between the last frame with a good
value in the old block and the first one in the new block. Period: 20 ms.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from common import Child, begin, table

from shmio.config import Address
from shmio.layout.model import Layout
from shmio.model.statuses import StatusArea
from shmio.segment import Block, Frame, Segment
from shmio.testing.cell import Cell, until
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port

NAME = f"reload-{os.getpid()}"
PATH = "v0"
SOURCE = """
[[source]]
name = "by_{name}"
connector = "{name}"
layout = "{name}.toml"
period_ms = 20
timeout = {timeout}
{keys}
"""


class Plant:
    """An instance with a source for each device."""

    def __init__(self, folder: Path, devices: Mapping[str, tuple[str, str]]) -> None:
        self._folder, self._devices = folder, devices
        self.cell = Cell(folder, NAME, Address("127.0.0.1", 1))
        self._more = dict.fromkeys(devices, False)
        self._timeouts = dict.fromkeys(devices, 2000)
        for name in devices:
            self._write(name)
        self.configure()

    def configure(self, restarted: str = "") -> None:
        """Write the configuration; the source ``restarted`` gets another time-out."""
        if restarted:
            self._timeouts[restarted] += 1
        sources = [
            SOURCE.format(name=name, keys=keys, timeout=self._timeouts[name])
            for name, (keys, _) in self._devices.items()
        ]
        (self._folder / "supervisor.toml").write_text(f'[instance]\nname = "{NAME}"\n{"".join(sources)}')

    def _write(self, name: str) -> None:
        """Write a source's tag table with one or two registers."""
        address = self._devices[name][1]
        rows = [
            f'"v{n}" = {{ type = "REAL", address = "{address.format(n, 2 * n)}" }}' for n in range(1 + self._more[name])
        ]
        (self._folder / f"{name}.toml").write_text("\n".join(["[registers]", *rows]))

    def gap_ms(self, segment: Segment, name: str, *, restart: bool) -> float:
        """Reload with a change of one source, and return how long its values were missing, in ms."""
        old = segment.blocks[f"by_{name}"]
        self._more[name] = not self._more[name]
        self._write(name)
        self.configure(name if restart else "")
        done = self.cell.output("shmio-supervisor", "reload")
        if ("keeps its connection" in done) == restart:
            raise SystemExit(f"the reload did something else: {done}")

        def there() -> bool:
            segment.refresh()
            return segment.blocks[f"by_{name}"] is not old and bool(good(segment.blocks[f"by_{name}"]))

        until(there, "a good value in the new block")
        return (good(segment.blocks[f"by_{name}"])[0].publish_ns - good(old)[-1].publish_ns) / 1e6


def good(block: Block) -> list[Frame]:
    """Return the frames of a block whose first register has a good value, from the oldest on."""
    layout: Layout = block.layout
    area, index = StatusArea(layout), layout.by_path[PATH]
    last = block.latest()
    frames = [block.read(number) for number in range(1, last.number + 1)] if last is not None else []
    return [one for one in frames if one is not None and one.reason == "" and area.get(one.raw, index).code == 0]


def repeat(stack: ExitStack, ask: Callable[[int], object]) -> None:
    """Call a function 50 times a second in a thread."""
    stopping = threading.Event()

    def run() -> None:
        number = 0
        while not stopping.wait(0.02):
            ask(number := number + 1)

    thread = threading.Thread(target=run)
    thread.start()
    stack.callback(thread.join)
    stack.callback(stopping.set)


def main() -> None:
    quick = begin("Reload: how long a source's values are missing")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        modbus = stack.enter_context(Child("modbus_peer.py", 2))
        opcua = stack.enter_context(Child("opcua_peer.py", "asyncua", 2, 20))
        devices = {
            "modbus": (f'host = "127.0.0.1"\nport = {modbus.hello}', "holding {1}"),
            "opcua": (f'url = "opc.tcp://127.0.0.1:{opcua.hello}"\npublishing_ms = 20', "ns=2;s=cell/v{0}"),
        }
        if reason := missing():
            print(f"without mqtt: {reason}")
        else:
            address = stack.enter_context(reserved_port())
            broker = Mosquitto(folder, address)
            broker.start()
            stack.callback(broker.stop)
            device = stack.enter_context(Child("mqtt_peer.py", address.port, 2))
            repeat(stack, device.ask)
            devices["mqtt"] = f'url = "mqtt://{address}"\nmax_age_ms = 0', "plant/{0}"
        plant = Plant(folder, devices)
        plant.cell.up()
        stack.callback(plant.cell.down)
        segment = stack.enter_context(Segment.open(NAME))
        gaps: dict[tuple[str, bool], list[float]] = {(name, how): [] for name in devices for how in (False, True)}
        for name in devices:
            block = segment.blocks[f"by_{name}"]
            until(lambda block=block: bool(good(block)), f"a good value of {name}")  # type: ignore[misc]
        for _ in range(2 if quick else 6):  # each reload uses one of the 40 blocks for which there is room
            for (name, restart), found in gaps.items():
                found.append(plant.gap_ms(segment, name, restart=restart))
    middle = {key: statistics.median(found) for key, found in gaps.items()}
    rows = []
    for name in devices:
        kept, restarted = middle[name, False], middle[name, True]
        rows.append([name, f"{kept:.0f}", f"{restarted:.0f}", f"{restarted / kept:.1f}"])
    table(["gap in the values", "kept, ms", "restarted, ms", "restarted to kept"], rows)


if __name__ == "__main__":
    main()
