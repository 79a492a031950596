"""Virtual time in recordings: steps are recorded whole, however fast they come."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.cli.dump import main
from shmio.local.time_control import Coordinator
from shmio.recorder.recorder import Recorder
from shmio.recording.check import check
from shmio.recording.format.encoding import Reason, StepMark, decode_step, encode_json
from shmio.recording.reading.reader import Reader
from shmio.segment import Attributes, BlockSpec, Frame, ProcessSpec, Segment
from shmio.testing.cell import kill, until
from tests.unit.recorder.harness import LAYOUT, RING, Process, gaps, numbers, read, recorder

MS = 1_000_000
STEPS = 3 * RING


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    """Create a segment with stepped time, and run a source that answers each step."""
    block = BlockSpec("sim", LAYOUT, 20 * MS, 60_000 * MS, 1 << 22, Attributes("simulation", stepped=True))
    processes = [ProcessSpec("sim", "source"), ProcessSpec("recorder", "recorder")]
    with Segment.create(instance, [block], processes, stepped=True) as segment:
        assert segment.blocks["sim"].ring.slot_count == RING
        writer, page, over = segment.writer("sim"), segment.clock, threading.Event()
        bell = page.slot_bell(segment.processes.find("sim").index)

        def answer() -> None:
            handled = 0
            while not over.is_set():
                seen = bell.value()
                state = page.read()
                if state.stepping and state.step != handled:
                    handled = state.step
                    writer.at_ns = page.monotonic_ns(state.time_ns)
                    writer.publish(bytes(2), cycle=handled)
                else:
                    bell.wait(seen)

        thread = threading.Thread(target=answer)
        thread.start()
        yield segment
        over.set()
        bell.ring()
        thread.join()
        segment.unlink()


def cycles(file: Path) -> list[int]:
    """Return the cycles of the frames in a file."""
    return [message.item.cycle for message in read(file) if isinstance(message.item, Frame)]


def marks(file: Path) -> list[StepMark]:
    """Return the ends of steps in a file."""
    return [message.item for message in read(file) if isinstance(message.item, StepMark)]


def ready(process: Process) -> bool:
    return process.slot.report.pid == process.popen.pid and process.slot.report.note.startswith("to ")


def test_a_fast_run_is_recorded_whole(segment: Segment, tmp_path: Path) -> None:
    """If steps did not wait for the recorder, the rings would wrap several times between two of its reads."""
    with Process(segment, tmp_path) as process:
        until(lambda: ready(process), "its file")
        coordinator = Coordinator(segment)
        made = [coordinator.step(MS) for _ in range(STEPS)]
        file = process.file
        assert process.stop() == 0
    assert cycles(file) == [step.number for step in made]
    assert marks(file) == [StepMark(step.number, step.time_ns, step.dt_ns) for step in made]
    assert gaps(file) == []
    with Reader(file) as reader:
        assert check(reader).count == 0
    coordinator.close()


def test_a_steps_mark_follows_all_its_frames(segment: Segment, tmp_path: Path) -> None:
    recording = recorder(segment, tmp_path)
    coordinator = Coordinator(segment)
    for _ in range(3):
        coordinator.step(MS)
        recording.run_once()
    assert recording.tap.done == 3
    assert recording.close()
    items = [message.item for message in read(recording.output.path)]
    kinds = [
        item.cycle if isinstance(item, Frame) else -item.step for item in items if isinstance(item, Frame | StepMark)
    ]
    assert kinds == [1, -1, 2, -2, 3, -3]
    coordinator.close()


def test_steps_that_did_not_wait_for_the_recorder_have_gaps_and_no_marks(segment: Segment, tmp_path: Path) -> None:
    """A recorder outside the instance does not delay steps."""
    recording: Recorder = recorder(segment, tmp_path)
    coordinator = Coordinator(segment)
    for _ in range(STEPS):
        coordinator.step(MS)
    assert recording.close()
    file = recording.output.path
    (gap,) = gaps(file)
    assert (gap.first, gap.reason) == (1, Reason.NOT_RUNNING)
    assert numbers(file, "sim") == list(range(gap.last + 1, STEPS + 1))
    assert [mark.step for mark in marks(file)] == [STEPS]
    coordinator.close()


def test_steps_do_not_wait_for_a_killed_recorder_but_for_its_successor(segment: Segment, tmp_path: Path) -> None:
    coordinator = Coordinator(segment)
    with Process(segment, tmp_path) as first:
        until(lambda: ready(first), "its file")
        coordinator.step(MS)
        kill(first.popen.pid)
        first.popen.wait()
        for _ in range(10):
            coordinator.step(MS)
    with Process(segment, tmp_path) as second:
        until(lambda: ready(second), "the successor's file")
        for _ in range(STEPS):
            coordinator.step(MS)
        file = second.file
        assert second.stop() == 0
    assert {*range(2, 12 + STEPS)} <= {*cycles(file)}
    assert {*range(12, 12 + STEPS)} <= {mark.step for mark in marks(file)}
    coordinator.close()


def test_cat_prints_steps_unless_registers_are_chosen(
    segment: Segment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = recorder(segment, tmp_path)
    coordinator = Coordinator(segment)
    coordinator.step(20 * MS)
    assert recording.close()
    file = str(recording.output.path)
    assert main(["cat", file]) == 0
    assert "step 1 of 20 ms is done: 0.02 s" in capsys.readouterr().out
    assert main(["cat", "--json", file]) == 0
    assert '"step": 1, "clock_ns": 20000000, "dt_ns": 20000000' in capsys.readouterr().out
    assert main(["cat", file, "sim/count"]) == 0
    assert "step 1" not in capsys.readouterr().out
    coordinator.close()


@pytest.mark.parametrize("data", [b"", b"{}", b'{"step": -1, "time_ns": 0, "dt_ns": 0}', b"[" * 5000])
def test_invalid_steps_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        decode_step(data)


def test_a_step_survives_a_round_trip() -> None:
    mark = StepMark(7, 140 * MS, 20 * MS)
    assert decode_step(encode_json(mark)) == mark
