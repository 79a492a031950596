"""Makes the documentation's terminal recording from the real commands: ``python -m tests.system.terminal FILE``."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyte

from shmio.segment import running_instances
from shmio.testing.cell import BIN

AXIS: Final = "cell/Robot_800/Axs1_Pos"
COMMANDS: Final = (
    ("# a robot cell with an emulated PLC", 0.3),
    ("shmio-supervisor init --demo", 1.5),
    ("shmio-supervisor up --detach | tail -1", 2.0),  # the lines before name users of this host
    ("shmio-supervisor status", 4.0),
    ("clear", 0.2),
    ("# every value, with its quality, 50 times a second", 0.3),
    (f"shmio watch --lines -n 4 {AXIS}", 2.5),
    ("# for two seconds, every program sees 90 degrees instead", 0.3),
    (f"shmio inject --for 2 {AXIS} 90 & sleep 1; shmio get {AXIS}; wait", 2.5),
    ("# the recorder has stored every frame and event", 0.3),
    ("shmio-dump info dumps/*.mem | tail -3", 4.0),
    ("shmio-supervisor down", 2.0),
)
"""The commands, and for how many seconds their output stays."""
COLUMNS, ROWS = 92, 18
TYPING_S: Final = 0.045
TYPED: Final = 3
"""Number of characters that appear at once."""
TICK_S: Final = 0.1
"""Shortest time between two pictures."""
LONGEST_WAIT_S: Final = 1.5
"""Waits for output appear at most this long."""
FONT_PX, LINE_PX, CHAR_PX, EDGE_PX = 14, 19, 8.43, 14
COLORS: Final = {
    "default": "#d8dee9",
    "black": "#4c566a",
    "red": "#f28b82",
    "green": "#a3d9a5",
    "brown": "#f0d58c",
    "blue": "#8ab4f8",
    "magenta": "#d7aefb",
    "cyan": "#8be0e0",
    "white": "#eceff4",
}


class Picture(NamedTuple):
    """What the terminal shows, and for how long."""

    lines: tuple[str, ...]
    shown_s: float


def record(folder: Path) -> list[Picture]:
    """Run the commands in a folder, and return the pictures of the terminal."""
    screen = pyte.Screen(COLUMNS, ROWS)
    stream = pyte.ByteStream(screen)
    pictures: list[Picture] = []

    def show(seconds: float) -> None:
        lines = tuple(_line(screen, row) for row in range(ROWS))
        if pictures and pictures[-1].lines == lines:
            pictures[-1] = Picture(lines, pictures[-1].shown_s + seconds)
        else:
            pictures.append(Picture(lines, seconds))

    for command, stays_s in COMMANDS:
        stream.feed(b"$ ")
        show(0.4)
        for at in range(0, len(command), TYPED):
            stream.feed(command[at : at + TYPED].encode())
            show(TYPED * TYPING_S)
        stream.feed(b"\r\n")
        show(TICK_S)
        _run(command, folder, stream.feed, show)
        show(stays_s)
    return pictures


def _run(command: str, folder: Path, feed: Callable[[bytes], None], show: Callable[[float], None]) -> None:
    """Run a command in a terminal; pass its output to ``feed``, and the times between outputs to ``show``."""
    parent, child = pty.openpty()
    environment = os.environ | {
        "PATH": f"{BIN}:{os.environ['PATH']}",
        "TERM": "xterm-256color",
        "COLUMNS": str(COLUMNS),
        "LINES": str(ROWS),
    }
    with subprocess.Popen(
        ["bash", "-c", command], cwd=folder, env=environment, stdin=child, stdout=child, stderr=child
    ) as running:
        os.close(child)
        last = time.monotonic()
        while True:
            ready, _, _ = select.select([parent], [], [], TICK_S)
            try:
                data = os.read(parent, 65536) if ready else b""
            except OSError:  # the command has ended
                break
            if data:
                now = time.monotonic()
                show(min(now - last, LONGEST_WAIT_S))
                last = now
                feed(data)
            elif running.poll() is not None:
                break
        os.close(parent)
    if running.returncode:
        raise SystemExit(f"{command}: exit status {running.returncode}")


def _line(screen: Any, row: int) -> str:
    """Return a line as SVG: a tspan for each stretch with the same color."""
    parts: list[tuple[str, str]] = []
    for column in range(COLUMNS):
        char = screen.buffer[row][column]
        color = COLORS.get(char.fg, f"#{char.fg}" if len(char.fg) == 6 else COLORS["default"])
        style = f'fill="{color}"' + (' font-weight="bold"' if char.bold else "")
        if parts and parts[-1][0] == style:
            parts[-1] = style, parts[-1][1] + char.data
        else:
            parts.append((style, char.data))
    if not "".join(text for _, text in parts).strip():
        return ""
    parts[-1] = parts[-1][0], parts[-1][1].rstrip()
    return "".join(f"<tspan {style}>{escape(text)}</tspan>" for style, text in parts if text)


def drawn(pictures: list[Picture]) -> str:
    """Return an animated SVG, which needs no script."""
    width, height = round(COLUMNS * CHAR_PX + 2 * EDGE_PX), ROWS * LINE_PX + 2 * EDGE_PX
    numbers = {line: number for number, line in enumerate(dict.fromkeys(_shown(pictures)))}
    total_s = sum(picture.shown_s for picture in pictures)
    steps, at_s = [], 0.0
    for index, picture in enumerate(pictures):
        steps.append(f"{100 * at_s / total_s:.3f}%{{transform:translateY({-index * height}px)}}")
        at_s += picture.shown_s
    frames = "".join(
        f'<g transform="translate(0 {index * height})">'
        + "".join(
            f'<use href="#l{numbers[line]}" y="{EDGE_PX + (row + 1) * LINE_PX - 5}"/>'
            for row, line in enumerate(picture.lines)
            if line
        )
        + "</g>"
        for index, picture in enumerate(pictures)
    )
    lines = "".join(f'<text id="l{number}" x="{EDGE_PX}">{line}</text>' for line, number in numbers.items())
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">
<title>A cell is started, watched, injected, recorded and stopped by commands</title>
<style>
text{{font:{FONT_PX}px ui-monospace,"DejaVu Sans Mono",Menlo,Consolas,monospace;white-space:pre}}
#all{{animation:play {total_s:.1f}s step-end infinite}}
@keyframes play{{{"".join(steps)}}}
@media (prefers-reduced-motion:reduce){{#all{{animation-play-state:paused;animation-delay:-{0.8 * total_s:.1f}s}}}}
</style>
<defs>{lines}</defs>
<rect width="100%" height="100%" rx="8" fill="#20242c"/>
<g id="all">{frames}</g>
</svg>
"""


def _shown(pictures: list[Picture]) -> Iterator[str]:
    for picture in pictures:
        yield from (line for line in picture.lines if line)


def main(file: Path) -> int:
    """Record the commands, and write the SVG."""
    if "a50" in running_instances():
        print("an instance a50 is running; stop it first", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as folder:
        pictures = record(Path(folder))
    file.write_text(drawn(pictures))
    print(
        f"{file}: {len(pictures)} pictures, {sum(one.shown_s for one in pictures):.0f} s, {file.stat().st_size} bytes"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
