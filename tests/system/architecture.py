"""Makes the picture of an instance from a running one: ``python -m tests.system.architecture FILE``.

The instance is the demo's cell with more endpoints and a model. Names, addresses and sizes in the picture are those
that ``up``, ``status`` and ``list`` print.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from html import escape
from pathlib import Path
from typing import Any, Final, NamedTuple

from shmio.segment import running_instances
from shmio.testing.cell import Cell
from shmio.testing.ports import reserved_port

MORE: Final = """
[[source]]
name = "twin"
connector = "simulation"
model = "shmio.simulation.a50:A50Cell"
layout = "db201.db"
period_ms = 20
[opcua]
listen = "127.0.0.1:4840"
[metrics]
listen = "127.0.0.1:9464"
[[alert]]
name = "far"
when = "cell/Robot_800/Axs1_Pos > 45"
command = ["true"]
"""
STARTED: Final = re.compile(r"^  (\S+) +(\S+) +(.*)$", re.MULTILINE)
CLIENTS: Final = {
    "grpc": "programs elsewhere",
    "opcua": "SCADA, panels",
    "web": "browsers",
    "metrics": "Prometheus",
    "alerts": "people, by webhook",
    "recorder": ".mem files",
}
"""Who is behind each process. Behind the bridge to MQTT is the broker, a process, too."""
COMMANDING: Final = ("grpc", "mqtt", "opcua", "web")
"""Processes that also pass on commands of their clients."""
STYLE: Final = """
text{font:10.5px system-ui,"DejaVu Sans",sans-serif;text-anchor:middle;fill:#1f2937}
.t{font-weight:600;font-size:11.5px}.h{text-anchor:start;font-weight:600;fill:#475569}
rect{stroke-width:1.2}.f{fill:#f8fafc;stroke:#94a3b8;stroke-dasharray:5 4}
.p{fill:#e0e7ff;stroke:#6366f1}.d{fill:#fff;stroke:#64748b}
.m{fill:#dcfce7;stroke:#16a34a}.k{fill:#f0fdf4;stroke:#4ade80}.a{stroke:#475569;stroke-width:1.3}
"""
BACK: Final = 'marker-start="url(#b)"'
MARKS: Final = """<defs>
<marker id="e" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" fill="#475569"/></marker>
<marker id="b" viewBox="0 0 8 8" refX="1" refY="4" markerWidth="7" markerHeight="7" orient="auto"><path d="M8 0L0 4L8 8z" fill="#475569"/></marker>
</defs>"""  # noqa: E501


class Process(NamedTuple):
    """A process of the instance, as ``up`` describes it."""

    name: str
    kind: str
    does: str


class Instance(NamedTuple):
    """What the picture shows."""

    status: dict[str, Any]
    processes: list[Process]
    registers: dict[str, int]


def observe(folder: Path) -> Instance:
    """Run the instance, and ask it."""
    with reserved_port() as grpc:
        cell = Cell(folder, "a50", grpc)
    cell.output("shmio-supervisor", "init", "--demo")
    config = folder / "supervisor.toml"
    config.write_text(config.read_text() + MORE)
    started = cell.output("shmio-supervisor", "up", "--detach")
    try:
        names = [line.split()[0] for line in cell.output("shmio", "list").splitlines()]
        status = json.loads(cell.output("shmio-supervisor", "status", "--json"))
    finally:
        cell.output("shmio-supervisor", "down")
    processes = [Process(*found) for found in STARTED.findall(started)]
    registers = {
        one.name: sum(name.startswith(f"{one.name}/") for name in names) for one in processes if one.kind == "source"
    }
    return Instance(status, processes, registers)


def drawn(instance: Instance) -> str:
    """Return the picture as SVG: devices, sources, the segment, the other processes, and who is behind them."""
    by_name = {one.name: one for one in instance.processes}
    sources = [one for one in instance.processes if one.kind == "source"]
    emulators = [one for one in instance.processes if one.kind == "emulator"]
    others = [one for one in instance.processes if one.kind not in ("source", "emulator") and one.name != "broker"]
    rows = len(others)
    height = 96 + 52 * rows
    parts = [
        _box(170, 10, 595, height - 20, "f", []),
        _text(186, 32, "h", f"instance {instance.status['instance']} on one host; its processes are blue"),
        _box(375, 44, 170, 52 * rows - 8, "m", []),
        _text(460, 64, "t", f"segment {instance.status['segment']}"),
        _text(460, 79, "s", f"{instance.status['segment_bytes'] / 1e6:.1f} MB of shared memory"),
    ]
    step = (52 * rows - 60) / len(sources)
    for number, source in enumerate(sources):
        y = 92 + round(number * step)
        connector, _, layout = source.does.partition(", ")
        parts.append(
            _box(185, y, 155, 52, "p", [f"source {source.name}", connector.split()[0], layout.split(": ")[-1]])
        )
        block = [f"block {source.name}", f"{instance.registers[source.name]} registers", "frames, events, commands"]
        parts += [_box(383, y, 154, 52, "k", block), _arrow(340, 383, y + 26, both=True)]
        device = next((one for one in emulators if one.does.split()[2].rstrip(",") in connector), None)
        if device is not None:
            does = [f"emulator {device.name}", "instead of a device", _place(device.does)]
            parts += [_box(2, y, 148, 52, "p", does), _arrow(150, 185, y + 26, both=True)]
    for number, one in enumerate(others):
        y = 44 + 52 * number
        both = one.name in COMMANDING
        parts += [_box(595, y, 155, 44, "p", [one.name, _place(one.does)]), _arrow(545, 595, y + 22, both=both)]
        if one.name == "mqtt" and "broker" in by_name:
            parts.append(_box(800, y, 140, 44, "p", ["broker", _place(by_name["broker"].does)]))
        else:
            parts.append(_box(800, y, 140, 44, "d", [CLIENTS[one.name]]))
        parts.append(_arrow(750, 800, y + 22, both=both))
    y = 44 + 52 * rows
    parts += [
        _box(375, y, 375, 32, "p", ["supervisor: starts, watches, restarts, reloads"]),
        _box(185, y, 155, 32, "d", ["your local programs"]),
        f'<path class="a" d="M340 {y + 16} H358 V{y - 22} H375" fill="none" {BACK} marker-end="url(#e)"/>',
    ]
    title = "A running instance: sources write blocks of the segment; endpoints, recorder and local programs read them"
    size = f'viewBox="0 0 950 {height}" width="950" height="{height}"'
    head = [f'<svg xmlns="http://www.w3.org/2000/svg" {size}>', f"<title>{title}</title>", f"<style>{STYLE}</style>"]
    return "\n".join([*head, MARKS, '<rect width="100%" height="100%" fill="#fff"/>', *parts, "</svg>\n"])


def _place(does: str) -> str:
    """Return the addresses of a description by their ports, all on the host's loopback; others as they are."""
    ports = re.findall(r"127\.0\.0\.1:(\d+)", does)
    return f"port {', '.join(ports)}" if ports else re.sub(r"^to .*/", "to ", does)


def _box(x: int, y: int, width: int, height: int, kind: str, lines: list[str]) -> str:
    """Return a box with lines of text, of which the first is bold."""
    first = y + height / 2 + 4 - 7 * (len(lines) - 1)
    texts = [_text(x + width / 2, first + 14 * at, "s" if at else "t", line) for at, line in enumerate(lines)]
    return f'<rect class="{kind}" x="{x}" y="{y}" width="{width}" height="{height}" rx="6"/>' + "".join(texts)


def _text(x: float, y: float, kind: str, text: str) -> str:
    return f'<text class="{kind}" x="{x:g}" y="{y:g}">{escape(text)}</text>'


def _arrow(left: int, right: int, y: int, *, both: bool) -> str:
    back = f" {BACK}" if both else ""
    return f'<line class="a" x1="{left}" y1="{y}" x2="{right - 2}" y2="{y}" marker-end="url(#e)"{back}/>'


def main(file: Path) -> int:
    """Run the instance, and write the SVG."""
    if "a50" in running_instances():
        print("an instance a50 is running; stop it first", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as folder:
        file.write_text(drawn(observe(Path(folder))))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
