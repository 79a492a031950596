"""Steps of virtual time: requested, answered, delivered or failed. The participants are threads."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from shmio.errors import TimeError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.local.time_control import Coordinator, Step
from shmio.model.clock import Clock, ClockMode
from shmio.segment import Attributes, BlockSpec, BlockWriter, ProcessSpec, Quality, Segment

LAYOUT = Layout("DB1", 1, 4, False, (Register("count", "UDINT", (), 0, None, 4, 1),))
PERIOD_NS = 20_000_000
HARD_S = 0.05  # for steps that must fail
MS = 1_000_000


def spec(name: str, *, stepped: bool = True, period_ns: int = PERIOD_NS) -> BlockSpec:
    return BlockSpec(name, LAYOUT, period_ns, 500_000_000, 1 << 20, Attributes("simulation", stepped=stepped))


@contextmanager
def built(instance: str, *blocks: BlockSpec, stepped: bool = True) -> Iterator[Segment]:
    processes = [*(ProcessSpec(block.source, "source") for block in blocks), ProcessSpec("grpc", "grpc")]
    with Segment.create(instance, blocks, processes, stepped=stepped) as segment:
        yield segment
        segment.unlink()


class Participant:
    """A source that answers each step with the reason that ``answer`` returns. For None it does not answer."""

    def __init__(self, instance: str, name: str, answer: Callable[[Clock], str | None] = lambda _: "") -> None:
        self.segment = Segment.open(instance, writable=True)
        self.name, self.answer = name, answer
        self.steps: list[tuple[int, int, int]] = []
        self.slot = self.segment.processes.find(name)
        assert self.slot.take()
        self.bell = self.segment.clock.slot_bell(self.slot.index)
        self.writer: BlockWriter = self.segment.writer(name)
        self.over = False
        self.seen = self.bell.value()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        handled = self.segment.clock.read().step
        while not self.over:
            state = self.segment.clock.read()
            if state.stepping and state.step != handled:
                handled = state.step
                self.writer.at_ns = self.segment.clock.monotonic_ns(state.time_ns)
                self.steps.append((state.step, state.time_ns, state.dt_ns))
                answer = self.answer(state)
                if answer is not None:
                    quality = Quality.BAD if answer else Quality.GOOD
                    self.writer.publish(bytes(4), cycle=state.step, quality=quality, reason=answer)
            self.seen = self.bell.wait(self.seen)

    def __enter__(self) -> Participant:
        return self

    def __exit__(self, *_: object) -> None:
        self.over = True
        self.bell.ring()
        self.thread.join()
        self.segment.close()


def test_step_ends_when_all_sources_have_answered(instance: str) -> None:
    delivered: list[tuple[Step, Clock]] = []
    with built(instance, spec("a"), spec("b"), spec("plc", stepped=False)) as segment, ExitStack() as stack:
        coordinator = Coordinator(segment, deliver=lambda step: delivered.append((step, segment.clock.read())))
        parts = [stack.enter_context(Participant(instance, name)) for name in ("a", "b")]
        assert coordinator.step() == Step(1, 50 * MS, 50 * MS)
        assert coordinator.step(20 * MS) == Step(2, 70 * MS, 20 * MS)
        for part in parts:
            assert part.steps == [(1, 50 * MS, 50 * MS), (2, 70 * MS, 20 * MS)]
        state = coordinator.read()
        assert (state.step, state.done, state.time_ns, state.stepping) == (2, 2, 70 * MS, False)
        assert state.owner == os.getpid()
        assert [(step.number, state.done) for step, state in delivered] == [(1, 1), (2, 2)], (
            "a step is delivered once it is done"
        )


def test_step_without_a_participant_is_noted(instance: str) -> None:
    with built(instance, spec("plc", stepped=False), stepped=False) as segment:
        coordinator = Coordinator(segment)
        assert coordinator.step() == Step(1, coordinator.read().time_ns, 50 * MS)
        assert coordinator.read().note.startswith("no source uses the instance clock, so stepping has no effect; ")
        assert coordinator.read().note.endswith("; shmio step --release returns to real time"), (
            "the note is not cut off"
        )


def test_take_over_notes_how_to_return_to_real_time(instance: str) -> None:
    with built(instance, spec("a"), stepped=False) as segment, Participant(instance, "a"):
        coordinator = Coordinator(segment)
        coordinator.take_over()
        told = "it is paused until the next step; shmio step --release returns to real time"
        assert coordinator.read().note == told
        coordinator.step()
        assert coordinator.read().note == ""
    with built(instance, spec("plc", stepped=False), stepped=False) as segment:
        coordinator = Coordinator(segment)
        coordinator.take_over()
        assert coordinator.read().note.startswith("no source uses the instance clock")


def test_released_time_is_real_and_never_goes_back(instance: str) -> None:
    blocks = [spec("a"), spec("fast", period_ns=7 * MS), spec("slow", period_ns=1000 * MS)]
    with built(instance, *blocks, stepped=False) as segment, ExitStack() as stack:
        coordinator = Coordinator(segment)
        parts = [stack.enter_context(Participant(instance, block.source)) for block in blocks]
        number = 0
        for dt_ns in (MS, 3_600_000 * MS):  # more steps than periods have passed; then more time than has
            steps = [coordinator.step(dt_ns) for _ in range(20)]
            assert [step.number for step in steps] == list(range(steps[0].number, steps[0].number + 20))
            assert steps[0].number > number
            number = steps[-1].number
            coordinator.release()
            state, real = segment.clock.last_written(), segment.clock.read()
            assert (state.mode, state.owner, state.note) == (ClockMode.WALL, 0, "")
            assert steps[-1].time_ns <= real.time_ns <= segment.clock.present_ns() < steps[-1].time_ns + 3_600_000 * MS
            for block in segment.blocks.values():
                assert state.lead(block.period_ns) + real.time_ns // block.period_ns >= number, "no cycle twice"
            assert all(part.steps[-1][0] == number for part in parts)


def test_release_of_real_time_changes_nothing(instance: str) -> None:
    with built(instance, spec("a"), stepped=False) as segment:
        coordinator, before = Coordinator(segment), segment.clock.last_written()
        coordinator.release()
        assert segment.clock.last_written() == before
        coordinator.take_over()
        coordinator.release()
        before = segment.clock.last_written()
        coordinator.release()
        coordinator.close()
        assert segment.clock.last_written() == before


def test_release_by_the_owner_or_without_an_owner(instance: str) -> None:
    with built(instance, stepped=False) as segment, Segment.open(instance, writable=True) as other:
        first, second = Coordinator(segment), Coordinator(other)
        first.set_playing(True)
        with pytest.raises(TimeError, match=rf"another program \(pid {os.getpid()}\), which is playing it"):
            second.release()
        assert segment.clock.read().virtual
        first.close()
        second.release()
        assert not segment.clock.read().virtual
        with Segment.open(instance) as reader, pytest.raises(TimeError, match="writable=True"):
            Coordinator(reader).release()


def test_release_of_a_stepped_instance_is_refused(instance: str) -> None:
    with built(instance) as segment:
        with pytest.raises(TimeError, match=r'configuration says clock = "stepped"'):
            Coordinator(segment).release()
        assert segment.clock.read().virtual


def test_note_of_a_stepped_instance_does_not_offer_a_release(instance: str) -> None:
    with built(instance, spec("plc", stepped=False), stepped=True) as segment:
        coordinator = Coordinator(segment)
        coordinator.step()
        assert coordinator.read().note.endswith("continue in real time")


def test_frames_are_stamped_with_the_time_after_their_step(instance: str) -> None:
    with built(instance, spec("a")) as segment, Participant(instance, "a"):
        Coordinator(segment).step(hour := 3_600_000 * MS)
        block = segment.blocks["a"]
        frame = block.latest()
        assert frame is not None
        assert frame.clock_ns == hour
        assert frame.assess(block.stale_ns, block.now_ns())[0] is Quality.GOOD


def test_nothing_is_stale_while_a_long_step_is_under_way(instance: str) -> None:
    qualities: list[Quality] = []
    with built(instance, spec("a"), spec("b")) as segment:

        def look(state: Clock) -> str:
            block = segment.blocks["b"]
            frame = block.latest()
            if frame is not None:
                qualities.append(frame.assess(block.stale_ns, block.now_ns())[0])
            return ""

        with Participant(instance, "a", look), Participant(instance, "b"):
            coordinator = Coordinator(segment)
            for _ in range(3):
                coordinator.step(60_000 * MS)
    assert qualities
    assert set(qualities) == {Quality.GOOD}


def test_first_step_of_a_wall_instance_continues_its_cycle_numbers(instance: str) -> None:
    with built(instance, spec("a"), spec("slow", period_ns=10**12), stepped=False) as segment:
        segment.writer("slow").publish(bytes(4), cycle=0)
        coordinator = Coordinator(segment)
        before = coordinator.read()
        coordinator.take_over()
        state = coordinator.read()
        assert (before.mode, state.mode) == (ClockMode.WALL, ClockMode.VIRTUAL)
        assert state.time_ns >= before.time_ns
        assert state.step == state.done == state.time_ns // PERIOD_NS
        frozen = coordinator.read().time_ns
        with Participant(instance, "a"), Participant(instance, "slow"):
            assert coordinator.step().number == state.step + 1
        assert coordinator.read().time_ns == frozen + 50 * MS


def test_take_over_continues_from_a_frame_ahead_of_the_schedule(instance: str) -> None:
    with built(instance, spec("a"), stepped=False) as segment:
        segment.writer("a").publish(bytes(4), cycle=10**9)
        coordinator = Coordinator(segment)
        coordinator.take_over()
        assert coordinator.read().step == 10**9


def test_take_over_continues_from_a_cycle_under_way(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Time is paused first, so that no further cycle begins. A cycle under way still counts."""
    with built(instance, spec("a"), stepped=False) as segment:
        writer, write = segment.writer("a"), segment.clock.write
        modes: list[ClockMode] = []

        def told(state: Clock, *, ring: bool = True) -> None:
            write(state, ring=ring)
            modes.append(state.mode)
            if len(modes) == 1:
                writer.publish(bytes(4), cycle=10**9)

        monkeypatch.setattr(segment.clock, "write", told)
        coordinator = Coordinator(segment)
        coordinator.take_over()
        assert (modes[0], coordinator.read().step) == (ClockMode.VIRTUAL, 10**9)


def test_the_step_size_is_remembered_and_checked(instance: str) -> None:
    with built(instance) as segment:
        coordinator = Coordinator(segment)
        coordinator.set_step_size(20 * MS)
        assert coordinator.step().dt_ns == 20 * MS
        for wrong in (0, -5, 999, 3_600_000 * MS + 1):
            with pytest.raises(ValueRangeError, match=r"0\.001 ms to 3600000 ms"):
                coordinator.set_step_size(wrong)
            with pytest.raises(ValueRangeError, match=r"0\.001 ms to 3600000 ms"):
                coordinator.step(wrong)
        assert coordinator.read().step == 1
        coordinator.set_step_size(1_000)
        coordinator.step(3_600_000 * MS)


def test_failing_model_fails_the_step_by_name(instance: str) -> None:
    with built(instance, spec("a"), spec("b")) as segment:

        def raises_once(state: Clock) -> str:
            return "ZeroDivisionError: division by zero" if state.step == 1 else ""

        with Participant(instance, "a", raises_once), Participant(instance, "b") as other:
            coordinator = Coordinator(segment)
            with pytest.raises(TimeError, match="step 1: a: ZeroDivisionError: division by zero"):
                coordinator.step()
            state = coordinator.read()
            assert (state.step, state.done, state.stepping) == (1, 0, False)
            assert state.note == "step 1 failed: a: ZeroDivisionError: division by zero"
            assert len(other.steps) == 1
            assert coordinator.step() == Step(2, 100 * MS, 50 * MS)
            assert (coordinator.read().done, coordinator.read().note) == (2, "")


def test_silent_sources_are_named_and_the_step_number_is_used_up(instance: str) -> None:
    silent = {1}
    with built(instance, spec("a"), spec("b"), spec("c")) as segment:
        coordinator = Coordinator(segment, soft_s=HARD_S / 2, hard_s=HARD_S)
        with (
            Participant(instance, "a"),
            Participant(instance, "b", lambda state: None if state.step in silent else "") as part,
        ):
            part.slot.report = part.slot.report.__class__(pid=4711)
            with pytest.raises(TimeError) as caught:
                coordinator.step()
            assert str(caught.value) == (
                "step 1: b: no answer within 0.05 s from pid 4711; "
                "c: no answer within 0.05 s: its process does not run (stopped)"
            )
            assert coordinator.read().step == 1
            with Participant(instance, "c"):
                assert Coordinator(segment).step().number == 2


def test_step_that_is_not_waited_for_is_cancelled(instance: str) -> None:
    with built(instance, spec("a")) as segment:
        stepping = Coordinator(segment).stepping()
        assert next(stepping).block is segment.blocks["a"]
        assert segment.clock.read().stepping
        stepping.close()
        state = segment.clock.read()
        assert (state.stepping, state.step, state.done) == (False, 1, 0)
        assert state.note == "step 1 failed: it was cancelled"


def latest_cycle(segment: Segment, source: str) -> int:
    frame = segment.blocks[source].latest()
    return 0 if frame is None else frame.cycle


def test_note_names_the_awaited_source_after_the_soft_time_out(instance: str) -> None:
    with built(instance, spec("b"), spec("a")) as segment:
        coordinator = Coordinator(segment, soft_s=0.001, hard_s=60)

        def late(state: Clock) -> str:
            while latest_cycle(segment, "a") < state.step:
                segment.blocks["a"].ring.wait(segment.blocks["a"].ring.doorbell(), 1 * MS)
            while not segment.clock.read().note:
                segment.clock.bell.wait(segment.clock.bell.value(), 10 * MS)
            notes.append(segment.clock.read().note)
            return ""

        notes: list[str] = []
        with Participant(instance, "a"), Participant(instance, "b", late):
            coordinator.step()
        assert notes[0].startswith("step 1 waits for b")
        assert coordinator.read().note == ""


def test_block_that_a_reload_retires_is_not_waited_for(instance: str) -> None:
    with built(instance, spec("a")) as segment:
        coordinator = Coordinator(segment, hard_s=60)
        with Segment.open(instance, writable=True) as supervisor:
            with Participant(instance, "a", lambda _: supervisor.change(retire=["a"])):
                assert coordinator.step().number == 1
            assert coordinator.step().number == 2


def test_only_one_program_controls_time(instance: str) -> None:
    with built(instance) as segment, Segment.open(instance, writable=True) as other:
        first, second = Coordinator(segment), Coordinator(other)
        first.set_playing(True, 2.0)
        for call in (second.take_over, second.step, lambda: second.set_step_size(10 * MS)):
            with pytest.raises(
                TimeError,
                match=rf"moved by another program \(pid {os.getpid()}\), which is playing it; stop that program first$",
            ):
                call()
        assert (first.read().playing, first.read().rate) == (True, 2.0)
        first.set_playing(False)
        with pytest.raises(
            TimeError, match=rf"moved by another program \(pid {os.getpid()}\); wait until that program ends$"
        ):
            second.take_over(HARD_S)
        first.close()
        assert (second.read().playing, second.read().owner) == (False, 0)
        assert second.step().number == 1
        second.close()
        second.close()


def test_waiting_take_over_succeeds_when_the_owner_closes(instance: str) -> None:
    with built(instance) as segment, Segment.open(instance, writable=True) as other:
        first, second = Coordinator(segment), Coordinator(other)
        first.take_over()
        thread = threading.Thread(target=second.take_over, args=(60,))
        thread.start()
        first.step()
        first.close()
        thread.join()
        assert second.step().number == 2


def test_the_owner_is_named_if_it_is_a_process_of_the_instance(instance: str) -> None:
    with built(instance) as segment, Segment.open(instance, writable=True) as endpoint:
        slot = endpoint.processes.find("grpc")
        assert slot.take()
        slot.report = slot.report.__class__(pid=os.getpid())
        Coordinator(endpoint).take_over()
        with pytest.raises(TimeError, match=rf"moved by grpc \(pid {os.getpid()}\)"):
            Coordinator(segment).take_over()


def test_reader_cannot_control_time(instance: str) -> None:
    with built(instance), Segment.open(instance) as reader:
        with pytest.raises(TimeError, match="writable=True"):
            Coordinator(reader).take_over()
        assert Coordinator(reader).read().step == 0


def test_time_is_free_after_its_owner_was_killed(instance: str) -> None:
    owner = """
import sys
from dataclasses import replace
from shmio.segment import Segment
from shmio.local.time_control import Coordinator
segment = Segment.open(sys.argv[1], writable=True)
coordinator = Coordinator(segment, soft_s=0.001, hard_s=60)
coordinator.set_playing(True)
coordinator.step()
"""
    with built(instance, spec("a")) as segment:
        process = subprocess.Popen([sys.executable, "-c", owner, instance])
        try:
            while not segment.clock.read().note:  # the step waits for a source without a process
                segment.clock.bell.wait(segment.clock.bell.value(), 10 * MS)
            with pytest.raises(TimeError, match=rf"pid {process.pid}"):
                Coordinator(segment).take_over()
        finally:
            process.kill()
            process.wait()
        state = segment.clock.read()
        assert (state.step, state.done, state.stepping, state.playing) == (1, 0, True, False)
        assert segment.clock.last_written().playing
        coordinator = Coordinator(segment)
        coordinator.take_over()
        state = coordinator.read()
        assert (state.step, state.time_ns, state.stepping, state.playing) == (1, 50 * MS, False, False)
        assert state.note == "step 1 was not finished: the program that requested it has ended"
        with Participant(instance, "a") as part:
            assert coordinator.step() == Step(2, 100 * MS, 50 * MS)
            assert part.steps == [(2, 100 * MS, 50 * MS)], "the cancelled step is not carried out later"


def test_step_waits_for_other_processes_that_deliver(instance: str) -> None:
    with built(instance) as segment, Segment.open(instance, writable=True) as other:
        slot = other.processes.find("grpc")
        coordinator = Coordinator(segment, hard_s=60)
        assert slot.take()
        assert coordinator.step().number == 1, "the process has not announced that it delivers"
        other.clock.deliver(slot.index, other.clock.read().done)
        done: list[int] = []

        def deliver() -> None:
            clock = other.clock
            while not done:
                seen = clock.bell.value()
                if clock.read().done == 2:
                    done.append(2)
                    clock.deliver(slot.index, 2)
                else:
                    clock.bell.wait(seen)

        thread = threading.Thread(target=deliver)
        thread.start()
        assert coordinator.step().number == 2
        assert done == [2]
        thread.join()


def test_process_that_does_not_deliver_is_named(instance: str) -> None:
    with built(instance) as segment:
        with Segment.open(instance, writable=True) as other:
            slot = other.processes.find("grpc")
            assert slot.take()
            slot.report = slot.report.__class__(pid=4711)
            other.clock.deliver(slot.index, 0)
            coordinator = Coordinator(segment, soft_s=HARD_S, hard_s=HARD_S)
            with pytest.raises(TimeError, match=r"step 1: grpc \(pid 4711\) did not deliver the step within 0.05 s"):
                coordinator.step()
            assert coordinator.read().done == 1
        assert coordinator.step().number == 2, "a dead process is not waited for"


def test_coordinating_process_does_not_wait_for_itself(instance: str) -> None:
    with built(instance), Segment.open(instance, writable=True) as endpoint:
        slot = endpoint.processes.find("grpc")
        assert slot.take()
        endpoint.clock.deliver(slot.index, 0)
        assert Coordinator(endpoint, hard_s=60).step().number == 1


def test_threads_of_one_program_take_turns(instance: str) -> None:
    with built(instance, spec("a")) as segment, Participant(instance, "a") as part:
        coordinator = Coordinator(segment)
        numbers: list[int] = []
        threads = [
            threading.Thread(target=lambda: numbers.extend(coordinator.step().number for _ in range(10)))
            for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(numbers) == list(range(1, 41))
        assert [number for number, _, _ in part.steps] == list(range(1, 41))


def test_a_rate_is_checked(instance: str) -> None:
    with built(instance) as segment:
        for wrong in (0.0, -1.0, float("nan"), float("inf")):
            with pytest.raises(ValueRangeError, match="rate must be above 0"):
                Coordinator(segment).set_playing(True, wrong)
