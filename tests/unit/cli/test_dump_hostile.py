"""Damaged and truncated files: each verb reads what is intact, or reports the fault in one line."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import shmio
from shmio.cli.dump import main
from shmio.errors import ShmioError
from shmio.recording.format.encoding import Gap
from shmio.segment import Frame
from tests.unit.recording.build import PERIOD_NS, START_NS, varied

any_input = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, set[bytes]]:
    """Make a recording. Return its bytes, and the images in it."""
    file = varied(tmp_path_factory.mktemp("original") / "a.mem")
    with shmio.open_dump(file) as dump:
        images = {image for e in dump.items() if isinstance(e.item, Frame) for image in (e.item.raw, e.item.image)}
    return file.read_bytes(), images


VERBS = [
    ["info", "bad.mem"],
    ["verify", "bad.mem"],
    ["cat", "bad.mem"],
    ["cat", "--csv", "bad.mem", "cell"],
    ["recover", "bad.mem", "-o", "out.mem"],
    ["cut", "bad.mem", "-o", "out.mem", "--from", "0.2", "--only", "cell/count"],
    ["merge", "bad.mem", "-o", "out.mem"],
    ["export", "bad.mem", "-o", "out", "--format", "csv"],
    ["export", "bad.mem", "-o", "out.mem", "--format", "mcap"],
    ["diff", "bad.mem", "good.mem"],
]


def run(verb: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    for old in (*Path().glob("out/*"), Path("out.mem")):
        old.unlink(missing_ok=True)
    status = main(verb)
    said = capsys.readouterr()
    assert status in (0, 1), verb
    assert status == 0 or said.err or verb[0] in ("diff", "verify", "info"), f"{verb} gives a reason"
    assert "Traceback" not in said.err
    if Path("out.mem").exists() and verb[0] != "export":
        assert main(["verify", "out.mem"]) == 0, f"{verb} makes an undamaged file"
        capsys.readouterr()


def test_verbs_survive_a_flipped_bit(original: tuple[bytes, set[bytes]], capsys: pytest.CaptureFixture[str]) -> None:
    data, _ = original
    Path("good.mem").write_bytes(data)
    choice = random.Random(11)
    for _ in range(60):
        changed = bytearray(data)
        changed[choice.randrange(len(data))] ^= 1 << choice.randrange(8)
        Path("bad.mem").write_bytes(changed)
        run(choice.choice(VERBS), capsys)
        run(choice.choice(VERBS), capsys)


def test_verbs_survive_a_truncated_file(original: tuple[bytes, set[bytes]], capsys: pytest.CaptureFixture[str]) -> None:
    data, _ = original
    Path("good.mem").write_bytes(data)
    choice = random.Random(12)
    for _ in range(60):
        Path("bad.mem").write_bytes(data[: choice.randrange(len(data))])
        run(choice.choice(VERBS), capsys)


def read_all(file: Path, images: set[bytes], *, strict: bool) -> int:
    """Read all of a recording; check that its images are known, and return the number of frames."""
    told: list[object] = []
    with shmio.open_dump(file, None if strict else lambda *damage: told.append(damage)) as dump:
        count = 0
        for entry in dump.items():
            if isinstance(entry.item, Frame):
                assert entry.item.image in images
                count += 1
            else:
                assert not isinstance(entry.item, Gap) or entry.item.count < 100
        for source in dump.sources:
            for _, batch in dump.batches(source):
                assert {bytes(image) for image in batch.images} <= images
            dump.latest(source, START_NS + 20 * PERIOD_NS)
            list(dump.frames(source, START_NS + 30 * PERIOD_NS, START_NS + 40 * PERIOD_NS))
        return count


@any_input
@given(data=st.data(), strict=st.booleans())
def test_changed_bytes_yield_only_original_images(
    original: tuple[bytes, set[bytes]], tmp_path: Path, data: st.DataObject, strict: bool
) -> None:
    content, images = original
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(1, 3))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "bad.mem").write_bytes(changed[: data.draw(st.integers(len(changed) - 2000, len(changed)))])
    try:
        read_all(tmp_path / "bad.mem", images, strict=strict)
    except ShmioError as error:
        assert "\n" not in str(error)  # noqa: PT017  one line, whichever it is


def test_truncation_within_the_last_chunk_loses_only_that_chunk(
    original: tuple[bytes, set[bytes]], tmp_path: Path
) -> None:
    content, images = original
    file = tmp_path / "a.mem"
    file.write_bytes(content)
    with shmio.open_dump(file) as dump:
        *_, before, last = (chunk for chunk, _, _ in dump._parts[0].found.chunks.between(0, 2**62))
        everything = len(list(dump.frames("cell"))) + len(list(dump.frames("press")))
    counts = set()
    for size in range(before.at + before.size, last.at + last.size + 1, 3):
        file.write_bytes(content[:size])
        counts.add(read_all(file, images, strict=True))
    file.write_bytes(content[: last.at + last.size])
    counts.add(read_all(file, images, strict=True))
    assert max(counts) == everything
    assert len(counts) == 2
