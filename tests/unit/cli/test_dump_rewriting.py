"""``shmio-dump recover``, ``cut`` and ``merge``: new recordings from others."""

from __future__ import annotations

import errno
import json
import os
import random
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader

import shmio
from shmio.cli.dump import main
from shmio.cli.recordings.common import Progress
from shmio.recording.check import check
from shmio.recording.format.encoding import Gap, Reason, StepMark
from shmio.recording.format.records import MAGIC
from shmio.recording.reading.reader import Reader
from shmio.segment import Event, Frame
from tests.unit.recording.build import PERIOD_NS, START_NS, build, image, plain, varied

Output = Callable[[], tuple[list[str], list[str]]]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(*files: Path) -> list[tuple[int, str, object]]:
    """Return everything in recorded order. Gaps lack their block's number, which differs between files."""
    with shmio.open_dump(files) as dump:
        return [
            (
                e.time_ns,
                e.block.source if e.block else "",
                (e.item.what, e.item.first, e.item.last, e.item.reason) if isinstance(e.item, Gap) else e.item,
            )
            for e in dump.items()
        ]


def whole(file: Path) -> None:
    """Assert that shmio and the MCAP library find a file undamaged."""
    with Reader(file) as reader:
        assert check(reader).whole
        assert reader.records.closed
    with file.open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary() is not None


def test_cut_by_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = varied(tmp_path / "a.mem")
    part = tmp_path / "part.mem"
    assert main(["cut", str(file), "-o", "part.mem", "--from", "0.3", "--to", "0.78"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("part.mem: closed; ")
    assert out[1] == "  47 frames and 1 events"
    whole(part)
    low, high = START_NS + 16 * PERIOD_NS, START_NS + 40 * PERIOD_NS
    assert contents(part) == [entry for entry in contents(file) if low <= entry[0] <= high]
    assert part.stat().st_mode & 0o777 == 0o600
    assert main(["info", "part.mem"]) == 0
    assert "converted by shmio-dump cut" in capsys.readouterr().out
    assert main(["cut", str(file), "-o", "part.mem"]) == 1
    assert capsys.readouterr().err == "part.mem: this file exists already; choose another name, or remove the file\n"
    assert main(["cut", str(file), "-o", "none.mem", "--from", "100"]) == 1
    assert re.fullmatch(r"\S+ has nothing in that time; it goes from .* to .*\n", capsys.readouterr().err)
    assert not Path("none.mem").exists()


def test_cut_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    varied(tmp_path / "a.mem")
    words = ["cut", "--json", "a.mem", "-o", "part.mem", "--from", "0.3", "--to", "0.78"]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == {"file": "part.mem", "frames": 47, "events": 1, "damage": []}
    assert main(words) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {"error": "part.mem: this file exists already; choose another name, or remove the file"}
    assert err == "part.mem: this file exists already; choose another name, or remove the file\n"


def test_cut_by_source_and_register(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = varied(tmp_path / "a.mem")
    assert main(["cut", str(file), "-o", "press.mem", "--source", "press"]) == 0
    whole(Path("press.mem"))
    assert contents(Path("press.mem")) == [entry for entry in contents(file) if entry[1] in ("press", "")]
    assert main(["cut", str(file), "-o", "few.mem", "--only", "cell/count", "cell/row/2"]) == 0
    whole(Path("few.mem"))
    with shmio.open_dump("few.mem") as few, shmio.open_dump(file) as all_of_it:
        assert few.sources == ("cell",)
        assert [register.path for register in few.blocks[0].layout.registers] == ["count", "row"]
        for path in ("cell/count", "cell/row"):
            assert few.columns(path)[path[5:]].tolist() == all_of_it.columns(path)[path[5:]].tolist()
        for entry in few.frames("cell"):
            assert not any(entry.item.image[2:8])
        assert few.blocks[0].of == all_of_it.blocks[0].layout_hash
    assert main(["cut", "few.mem", "-o", "fewer.mem", "--only", "cell/row"]) == 0
    assert main(["recover", "fewer.mem", "-o", "again.mem"]) == 0
    with shmio.open_dump("again.mem") as fewer, shmio.open_dump(file) as all_of_it:
        assert fewer.blocks[0].of == all_of_it.blocks[0].layout_hash, "the hash of the original layout, after two cuts"
    assert main(["cut", str(file), "-o", "no.mem", "--only", "cell/nothing"]) == 1
    assert "no such register" in capsys.readouterr().err


def test_merge_of_files_that_follow_each_other(tmp_path: Path) -> None:
    files = [plain(tmp_path / "b.mem", 41, 60), plain(tmp_path / "a.mem", 1, 45), plain(tmp_path / "c.mem", 71, 90)]
    assert main(["merge", *map(str, files), "-o", "all.mem"]) == 0
    whole(Path("all.mem"))
    assert contents(Path("all.mem")) == contents(*files)
    with shmio.open_dump("all.mem") as dump:
        assert [(gap.first, gap.last, gap.reason) for gap in dump.gaps] == [(61, 70, Reason.ELSEWHERE)]


def test_merge_of_files_of_different_sources(tmp_path: Path) -> None:
    one = plain(tmp_path / "a.mem", 1, 150)
    with build(tmp_path / "b.mem") as work:
        work.block("press", section=2)
        for number in range(1, 151):
            work.frame(number, image(number), "press")
    assert main(["merge", str(one), "b.mem", "-o", "all.mem"]) == 0
    whole(Path("all.mem"))
    found = contents(Path("all.mem"))
    assert len(found) == 300
    assert [time_ns for time_ns, _, _ in found] == sorted(time_ns for time_ns, _, _ in found)


def test_merge_of_a_block_with_nothing_but_gaps(tmp_path: Path) -> None:
    with build(tmp_path / "a.mem") as work:
        work.block("cell")
        work.block("press", section=2)
        work.frame(1, image(1))
        work.gap(1, 7, "press")
    assert main(["merge", "a.mem", "-o", "b.mem"]) == 0
    whole(Path("b.mem"))
    assert contents(Path("b.mem")) == contents(Path("a.mem"))


def test_merge_of_different_runs_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with build(tmp_path / "b.mem", epoch="11" * 8) as work:
        work.block("cell")
        work.frame(1, image(1))
    assert main(["merge", str(plain(tmp_path / "a.mem")), "b.mem", "-o", "all.mem"]) == 1
    assert "come from different runs" in capsys.readouterr().err


def test_recover_keeps_every_undamaged_chunk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = varied(tmp_path / "a.mem")
    original = file.read_bytes()
    with Reader(file) as reader:
        chunks = [record for record in reader.records.walk() if record.opcode == Opcode.CHUNK]
    damaged = bytearray(original)
    damaged[chunks[1].at + 70] ^= 1
    file.write_bytes(damaged)
    assert main(["recover", str(file)]) == 0
    out = capsys.readouterr().out.splitlines()
    recovered = tmp_path / "a-recovered.mem"
    assert file.read_bytes() == damaged, "recover does not change its input"
    assert any(line.startswith("  lost after ") for line in out)
    whole(recovered)
    file.write_bytes(original)
    kept = [entry for entry in contents(recovered) if not (isinstance(entry[2], tuple) and entry[2][3] == "damaged")]
    before = contents(file)
    lost = [entry for entry in before if entry not in kept]
    assert kept == [entry for entry in before if entry in kept]
    with Reader(recovered) as reader:
        gaps = [message.item for message in reader.messages() if isinstance(message.item, Gap)]
    missing = sum(gap.count for gap in gaps if gap.reason == Reason.DAMAGED)
    assert missing == sum(isinstance(item, Frame | Event) for _, _, item in lost) > 0
    assert out[-1] == f"  {missing} frames and events between these are lost"


def test_recover_of_a_file_cut_off_at_every_byte_of_its_last_chunk(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = varied(tmp_path / "a.mem", first=41)
    data = file.read_bytes()
    before = contents(file)
    with Reader(file) as reader:
        chunk = [record for record in reader.records.walk() if record.opcode == Opcode.CHUNK][-1]
    cut, new = tmp_path / "cut.mem", tmp_path / "cut-recovered.mem"
    sizes = set()
    for size in range(chunk.start, chunk.at + chunk.size + 1):
        cut.write_bytes(data[:size])
        assert main(["recover", "cut.mem"]) == 0, capsys.readouterr().err
        assert "  cut.mem: not closed (it " in capsys.readouterr().out
        if size in (chunk.start, chunk.at + chunk.size):
            whole(new)
        found = contents(new)
        assert found == before[: len(found)]
        sizes.add(len(found))
        new.unlink()
    assert len(sizes) == 2
    assert max(sizes) == len(before)


def test_recover_of_a_file_that_is_no_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with build(Path("x.mem")):
        pass
    assert main(["recover", "x.mem"]) == 1
    assert capsys.readouterr().err == "x.mem: the recording is empty\n"
    for content, message in ((b"", "is empty"), (b"nothing", "is not a recording"), (MAGIC, "has no content")):
        Path("x.mem").write_bytes(content)
        assert main(["recover", "x.mem"]) == 1
        assert message in capsys.readouterr().err
        assert not Path("x-recovered.mem").exists()


def test_a_flipped_bit_anywhere_is_found_and_costs_one_chunk_at_most(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """``verify`` finds the damage; ``recover`` makes an undamaged file of original content."""
    file = varied(tmp_path / "a.mem")
    data = file.read_bytes()
    before = contents(file)
    largest = max(sum(1 for e in before if e[0] // (10 * PERIOD_NS) == t // (10 * PERIOD_NS)) for t, _, _ in before) + 2
    choice = random.Random(5)
    bad, new = tmp_path / "bad.mem", tmp_path / "bad-recovered.mem"
    for _ in range(150):
        place = choice.randrange(len(data))
        changed = bytearray(data)
        changed[place] ^= 1 << choice.randrange(8)
        bad.write_bytes(changed)
        assert main(["verify", "bad.mem"]) == 1, f"byte {place}"
        status = main(["recover", "bad.mem"])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        if status:
            assert place < 2000, said.err  # the magic, or the only copy of the layout
            continue
        whole(new)
        kept = [e for e in contents(new) if not (isinstance(e[2], tuple) and e[2][3] == "damaged")]
        assert all(entry in before for entry in kept)
        frames = [e for e in before if isinstance(e[2], Frame | Event | StepMark)]
        if len(kept) < len(before) - largest:
            assert place < 6000, f"byte {place}: {len(frames)} and {len(kept)}"  # an attachment: a block's layout
        new.unlink()


NEW = [("cut", "new.mem"), ("merge", "new.mem"), ("recover", "new.mem"), ("export", "new.mcap"), ("export", "tables")]


def options(verb: str, output: str) -> list[str]:
    """Return the additional options by which ``export`` writes one file."""
    return ["--format", "mcap" if output == "new.mcap" else "csv", "--source", "cell"] if verb == "export" else []


@pytest.mark.parametrize(("verb", "output"), NEW)
def test_full_disk_is_reported_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], verb: str, output: str
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    file, new = varied(tmp_path / "a.mem"), tmp_path / output
    monkeypatch.setattr(os, "fsync", full)
    assert main([verb, str(file), "-o", str(new), *options(verb, output)]) == 1
    path = new if new.suffix else new / "cell.csv"
    assert capsys.readouterr().err == f"{path}: No space left on device\n"
    assert not new.exists()


@contextmanager
def signal_handler(sign: signal.Signals, handler: Any) -> Iterator[None]:
    """Replace the handler of a signal until the context ends."""
    before = signal.signal(sign, handler)
    try:
        yield
    finally:
        signal.signal(sign, before)


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize(("verb", "output"), NEW)
def test_signal_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str, output: str, sign: signal.Signals
) -> None:
    """The signal comes after some frames are written, and again while the file is removed."""
    file = varied(tmp_path / "a.mem")
    made: list[Path] = []
    unlink = Path.unlink

    def tell(*_: object) -> None:
        made.extend(path for path in tmp_path.rglob("*") if path.is_file() and path != file)
        signal.raise_signal(sign)

    def unlink_late(path: Path, missing_ok: bool = False) -> None:
        if sign != signal.SIGINT:
            signal.raise_signal(sign)
        unlink(path, missing_ok)

    monkeypatch.setattr(Progress, "at", tell)
    monkeypatch.setattr(Path, "unlink", unlink_late)
    with signal_handler(sign, signal.default_int_handler if sign == signal.SIGINT else lambda *_: None):
        try:
            status: object = main([verb, str(file), "-o", str(tmp_path / output), *options(verb, output)])
        except SystemExit as end:
            status = end.code
    assert (len(made), status) == (1, 128 + sign)
    assert list(tmp_path.iterdir()) == [file]


def test_ignored_hang_up_does_not_end_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """nohup makes a command ignore SIGHUP."""
    file = varied(tmp_path / "a.mem")
    monkeypatch.setattr(Progress, "at", lambda *_: signal.raise_signal(signal.SIGHUP))
    with signal_handler(signal.SIGHUP, signal.SIG_IGN):
        assert main(["cut", str(file), "-o", "new.mem"]) == 0
    whole(Path("new.mem"))
