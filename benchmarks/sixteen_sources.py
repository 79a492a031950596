"""16 sources of 1,000 registers at 10 Hz: 8 of S7, 4 of OPC UA and 4 of Modbus.

Each S7 and Modbus source has an emulated device in a process of its own, whose values do not change: devices that
move all of them need more of the two cores than the sources. The OPC UA sources subscribe to one server, shmio's
endpoint in another process, where all values change at 10 Hz. The CPU use of the devices is reported separately,
because a plant has real ones. *Elsewhere* is the use of other programs: if it is large, the figures measure the
machine and not shmio. *Due to frame* is as in ``scaling.py``.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from common import Child, begin, quantiles, table
from instance import started
from scaling import Usage, delays_ms

from shmio.segment import Quality
from shmio.testing.ports import reserved_port

REGISTERS = 1000
PERIOD_MS = 100
KINDS = {"s7": 8, "opcua": 4, "modbus": 4}
SETTLE_S = 60.0
_ADDRESSES = {"s7": "DB1.DBD{four}", "opcua": "ns=2;s=cell/v{number}", "modbus": "holding {two}"}
_SOURCE = """
[[source]]
name = "{name}"
connector = "{kind}"
layout = "{layout}"
period_ms = {period_ms}
timeout = 5000
{peer}
"""
_EMULATOR = """
[[emulator]]
name = "device-{name}"
kind = "{kind}"
listen = "{address}"
"""


def tag_table(kind: str, registers: int) -> str:
    """Return a tag table of REALs in a device of this kind."""
    lines = (
        f'"v{n}" = {{ type = "REAL", address = "{_ADDRESSES[kind].format(number=n, two=2 * n, four=4 * n)}" }}'
        for n in range(registers)
    )
    return "\n".join(("[registers]", *lines, ""))


def measure(kinds: dict[str, int], registers: int, duration_s: float) -> None:
    """Run an instance with so many sources of each kind, and print its table."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        server = stack.enter_context(Child("opcua_peer.py", "shmio", registers, PERIOD_MS))
        names: dict[str, list[str]] = {}
        parts = []
        for kind, count in kinds.items():
            layout = folder / f"{kind}.toml"
            layout.write_text(tag_table(kind, registers))
            for number in range(count):
                name = f"{kind}{number}"
                names.setdefault(kind, []).append(name)
                peer = f'url = "opc.tcp://127.0.0.1:{server.hello}"'
                if kind != "opcua":
                    address = stack.enter_context(reserved_port())
                    peer = f'host = "{address.host}"\nport = {address.port}'
                    parts.append(_EMULATOR.format(name=name, kind=kind, address=address))
                parts.append(_SOURCE.format(name=name, kind=kind, layout=layout, period_ms=PERIOD_MS, peer=peer))
        running = stack.enter_context(started([], more="".join(parts)))
        sources = [name for some in names.values() for name in some]
        deadline_s = time.monotonic() + SETTLE_S
        while not all(_is_good(running.segment.blocks[name].latest()) for name in sources):
            if time.monotonic() > deadline_s:
                raise SystemExit("not all sources became good")
            time.sleep(0.1)
        slots = {name: running.segment.processes.find(name) for name in sources}
        before = {
            name: (slots[name].counters["overruns"], running.segment.blocks[name].ring.head()) for name in sources
        }
        usage = Usage(
            {kind: [running.pids[name] for name in some] for kind, some in names.items()}
            | {
                "devices": [server.pid, *(pid for name, pid in running.pids.items() if name.startswith("device-"))],
                "supervisor, gRPC": [running.pids["supervisor"], running.pids["grpc"]],
            }
        )
        begun_s = time.monotonic()
        time.sleep(duration_s)
        used, taken_s = usage.percent(), time.monotonic() - begun_s
        rows = []
        for kind, some in names.items():
            overruns = sum(slots[name].counters["overruns"] - before[name][0] for name in some)
            frames = sum(running.segment.blocks[name].ring.head() - before[name][1] for name in some)
            delays = quantiles(delays_ms(running, some, min(80, int(taken_s * 1000 / PERIOD_MS))))
            rows.append([
                f"{len(some)} of {kind}", f"{used[kind] / len(some):.1f}", f"{frames / taken_s / len(some):.2f}",
                str(overruns), f"{delays[0]:.1f}", f"{delays[2]:.1f}", str(_bad(running.segment.blocks, some)),
            ])  # fmt: skip
        titles = ["% of a core, each", "frames/s, each", "overruns", "due to frame, ms", "p99", "not good at the end"]
        table([f"{registers} registers at {1000 // PERIOD_MS} Hz", *titles], rows)
        table(
            ["% of a core", "used"],
            [
                ["all sources", f"{sum(used[kind] for kind in names):.0f}"],
                *([name, f"{used[name]:.0f}"] for name in ("supervisor, gRPC", "devices", "elsewhere", "all")),
            ],
        )


def _is_good(frame: object) -> bool:
    return getattr(frame, "quality", None) is Quality.GOOD


def _bad(blocks: object, names: Sequence[str]) -> int:
    return sum(not _is_good(blocks[name].latest()) for name in names)  # type: ignore[index]


def main() -> None:
    quick = begin("16 sources of 1,000 registers at 10 Hz: S7, OPC UA, Modbus")
    if quick:
        measure(dict.fromkeys(KINDS, 1), 50, 1.0)
    else:
        measure(KINDS, REGISTERS, 20.0)


if __name__ == "__main__":
    main()
