"""Kills the recorder of a whole cell with SIGKILL, again and again, and prints how much data that loses.

``not written``: frames published before the kill that the file did not have, by a copy made at once. ``recovered``:
frames that ``shmio-dump recover`` finds in that copy. ``missing``: frames that are in neither the closed file nor the
successor's, which starts with the frames still in the ring (of the ordinary size). ``told``: how many of these the
recording reports as a gap. The mcap library opens each file and each recovered copy, and checks every checksum.
"""

from __future__ import annotations

import random
import shutil
import struct
import tempfile
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from common import begin, table
from instance import instance
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader

from shmio.cli.dump import main as dump
from shmio.recording.reading.reader import Reader
from shmio.recording.reading.survey import survey
from shmio.segment import Activity, Segment
from shmio.testing.cell import kill, until

KILLS = 20
PERIOD_MS = 20
STABLE_S = 6.0  # one that ran this long is started again at once
SEED = 20


class Killed(NamedTuple):
    """One kill: how long the recorder ran, the last frame published, and the frames written and recovered."""

    ran_s: float
    head: int
    written: list[int]
    recovered: list[int]


def frames(file: Path, *, closed: bool) -> list[int]:
    """Return the numbers of a file's frames, read with the mcap library.

    Of a file that was not closed, read what is there.
    """
    found = []
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True) if closed else NonSeekingReader(stream, validate_crcs=True)
        try:
            for _, _, message in reader.iter_messages(topics=["cell/frames"], log_time_order=False):
                found.append(message.sequence)
        except (EndOfFile, struct.error):
            if closed:
                raise
    return found


def one(segment: Segment, folder: Path, copies: Path, wait_s: float) -> Killed:
    """Kill the recorder after a while, and wait until its successor records."""
    slot = segment.processes.find("recorder")
    until(lambda: slot.report.activity is Activity.RUNNING and slot.report.note.startswith("to "), "a recorder at work")
    pid, file = slot.report.pid, folder / slot.report.note.removeprefix("to ")
    time.sleep(wait_s)
    ran_s = (time.monotonic_ns() - slot.report.started_ns) / 1e9
    head = segment.blocks["cell"].ring.head()
    kill(pid)
    copy = copies / file.name
    shutil.copyfile(file, copy)  # as long as nobody closes it
    written = frames(copy, closed=False)
    new = copy.with_suffix(".recovered")
    with redirect_stdout(StringIO()):
        if dump(["recover", str(copy), "-o", str(new)]):
            raise SystemExit(f"shmio-dump cannot recover {copy}")
    until(lambda: slot.report.pid != pid, "its successor")
    return Killed(ran_s, head, written, frames(new, closed=True))


def ends(folder: Path) -> list[tuple[list[int], int]]:
    """Return, for each file in order, its frames and the number of frames that its gaps report as missing."""
    found = []
    for file in folder.iterdir():
        with Reader(file) as reader:
            told = sum(gap.count for gap in survey(reader).gaps if gap.what == "frames")
        found.append((frames(file, closed=True), told))
        with redirect_stdout(StringIO()) as said:
            if dump(["verify", str(file)]):
                raise SystemExit(said.getvalue())
    return sorted(found)


def rows(kills: Sequence[Killed], files: Sequence[tuple[list[int], int]]) -> list[list[str]]:
    """Return a line of the table for each kill."""
    found = []
    for number, (killed, (before, _), (after, told)) in enumerate(zip(kills, files, files[1:], strict=False), 1):
        late = killed.head - killed.written[-1]
        missing = after[0] - before[-1] - 1
        found.append(
            [
                str(number), f"{killed.ran_s:.2f}", str(late), f"{late * PERIOD_MS / 1e3:.2f}",
                f"{len(killed.recovered)} of {len(killed.written)}", str(missing), str(told),
            ]
        )  # fmt: skip
    return found


def main() -> None:
    count = 2 if begin("Recorder: what a kill costs") else KILLS
    chance = random.Random(SEED)
    with tempfile.TemporaryDirectory() as name:
        folder, copies = Path(name) / "dumps", Path(name) / "copies"
        copies.mkdir()
        with instance(PERIOD_MS, more=f'[recorder]\ndirectory = "{folder}"\n') as running:
            ring = running.segment.blocks["cell"].ring
            print(f"ring: {ring.slot_count} frames, {ring.slot_count * PERIOD_MS / 1e3:.1f} s")
            kills = [one(running.segment, folder, copies, STABLE_S + chance.uniform(0, 2)) for _ in range(count)]
            slot = running.segment.processes.find("recorder")
            until(lambda: slot.report.note.startswith("to "), "the last recorder at work")
        files = ends(folder)
    if len(files) != count + 1:
        raise SystemExit(f"{len(files)} files after {count} kills; expected one more file than kills")
    headings = ["kill", "ran, s", "not written: frames", "s", "recovered", "missing: frames", "told"]
    table(headings, rows(kills, files))


if __name__ == "__main__":
    main()
