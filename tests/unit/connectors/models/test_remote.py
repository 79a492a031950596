"""A source whose model runs in another program. In these tests, that program is a thread."""

from __future__ import annotations

import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import pytest

from shmio.connectors import registry
from shmio.connectors.models.remote import Remote
from shmio.errors import ConfigError, SegmentError, TimeError
from shmio.local.time_control import Coordinator
from shmio.local.writer import SourceWriter
from shmio.model.values import OutcomeKind
from shmio.segment import Attributes, BlockSpec, Frame, ProcessSpec, Provenance, Quality, Segment
from shmio.segment.model_channel import ModelChannel, ModelRequest
from tests.unit.connectors.models.test_stepped import GUEST, LAYOUT, MS, PATIENCE_S, PERIOD_NS, Running, latest, summed

NOBODY = "no model is connected"
LONG_MS = 9000
"""A time-out in ms that no test reaches."""
Compute = Callable[[ModelRequest], bytes | str | None]
"""Returns an image, or the reason of a failure, or None to send no answer."""
MUTE = """
import sys, time
from shmio.segment import Segment
with Segment.open(sys.argv[1], writable=True) as segment:
    link = segment.blocks["sim"].model_channel
    assert link.join("mute")
    print("joined", flush=True)
    while link.newest() is None:
        link.asked.wait(link.asked.doorbell(), 1_000_000)
    print("asked", flush=True)
    time.sleep(3600)
"""


@contextmanager
def built(instance: str, *, stepped: bool = True, inouts: tuple[str, ...] = ()) -> Iterator[Segment]:
    attributes = Attributes("remote", ("given", "sum"), stepped=True, outputs=("sum",), inouts=inouts)
    blocks = [
        BlockSpec("sim", LAYOUT, PERIOD_NS, 500 * MS, 1 << 20, attributes),
        BlockSpec("cell", LAYOUT, PERIOD_NS, 3_600_000 * MS, 1 << 20, Attributes("s7")),
    ]
    with Segment.create(instance, blocks, [ProcessSpec("sim", "source")], stepped=stepped) as segment:
        yield segment
        segment.unlink()


def remote(timeout_ms: float = LONG_MS, inouts: tuple[str, ...] = (), **connections: str) -> Remote:
    options = {"outputs": ["sum"], "inouts": list(inouts), "connections": connections, "timeout_ms": timeout_ms}
    made: Any = registry.load("remote")(registry.convert_options("remote", options), LAYOUT)
    return made  # type: ignore[no-any-return]


def add(ask: ModelRequest) -> bytes:
    """Add one and the inputs to ``sum``; also set the inputs, which no model may change, to 99."""
    (total,) = struct.unpack_from(">I", ask.shown)
    _, given, other = struct.unpack(">III", ask.commanded)
    return struct.pack(">III", total + 1 + given + other, 99, 99)


class Model:
    """A model, and the thread that answers for it."""

    def __init__(self, instance: str, compute: Compute = add, name: str = "adder") -> None:
        self.segment = Segment.open(instance, writable=True)
        found = self.segment.blocks["sim"].model_channel
        assert found is not None
        self.link: ModelChannel = found
        self.asks: list[ModelRequest] = []
        self.reached = threading.Event()
        """Set after the first request, whether the model answers it or not."""
        self._compute = compute
        self._handed = self.link.asked.head()
        self._stopping = False
        assert self.link.join(name)
        self._ring()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _ring(self) -> None:
        self.segment.clock.slot_bell(self.segment.processes.find("sim").index).ring()

    def _run(self) -> None:
        while not self._stopping:
            seen = self.link.asked.doorbell()
            if self.link.asked.head() != self._handed and (ask := self.link.newest()) is not None:
                self._handed = ask.number
                self.asks.append(ask)
                answer = self._compute(ask)
                if isinstance(answer, bytes):
                    self.link.answer(ask, 1, answer)
                elif answer is not None:
                    self.link.answer(ask, 1, ask.shown, answer)
                self.reached.set()
                continue
            self.link.asked.wait(seen, 20 * MS)

    def __enter__(self) -> Model:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping = True
        self._thread.join()
        self.link.leave()
        self._ring()
        self.segment.close()


def good(sim: Running) -> Frame:
    """Return the next frame that is not bad."""
    while (frame := sim.next()).quality is Quality.BAD:
        pass
    return frame


def failing(step: Callable[[], object]) -> tuple[threading.Thread, list[str]]:
    """Run a step that must fail in a thread; return the thread and the list for its error."""
    errors: list[str] = []

    def run() -> None:
        with pytest.raises(TimeError) as caught:
            step()
        errors.append(str(caught.value))

    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors


# ---- steps -----------------------------------------------------------------------------------------------------------


def test_remote_model_computes_only_its_outputs(instance: str) -> None:
    with built(instance) as segment, Running(segment, "sim", remote()) as sim, Model(instance) as model:
        first = good(sim)
        assert (first.cycle, summed(first), first.provenance) == (0, 0, Provenance.SIMULATED)
        coordinator, source_writer = Coordinator(segment), SourceWriter(segment.blocks["sim"], GUEST)
        coordinator.step(20 * MS)
        assert struct.unpack(">III", latest(segment, "sim").raw) == (1, 0, 0)
        (outcome,) = source_writer.write({"given": 7})
        assert outcome.kind is OutcomeKind.WRITTEN
        assert struct.unpack(">III", latest(segment, "sim").raw) == (1, 0, 0), (
            "a written input is shown from the next step on"
        )
        coordinator.step(30 * MS)
        assert struct.unpack(">III", latest(segment, "sim").raw) == (9, 7, 0)
        (outcome,) = source_writer.write({"sum": 7})
        assert outcome.kind is OutcomeKind.REFUSED
        told = "the model computes sum: outputs cannot be written; shmio inject can show another value"
        assert outcome.text == told
        assert [(ask.step, ask.time_ns, ask.dt_ns) for ask in model.asks] == [
            (1, 20 * MS, 20 * MS),
            (2, 50 * MS, 30 * MS),
        ]


def test_inout_register_has_a_commanded_and_a_shown_value(instance: str) -> None:
    def halve(ask: ModelRequest) -> bytes:
        (given,) = struct.unpack_from(">I", ask.commanded, 4)
        return struct.pack(">III", 0, given // 2, 0)

    inouts = ("given",)
    with (
        built(instance, inouts=inouts) as segment,
        Running(segment, "sim", remote(inouts=inouts)) as sim,
        Model(instance, halve) as model,
    ):
        good(sim)
        coordinator, source_writer = Coordinator(segment), SourceWriter(segment.blocks["sim"], GUEST)
        source_writer.write({"given": 8})
        for _ in range(2):
            coordinator.step()
        assert struct.unpack(">III", latest(segment, "sim").raw) == (0, 4, 0)
        assert [struct.unpack_from(">I", ask.commanded, 4) for ask in model.asks] == [(8,), (8,)]
        assert [struct.unpack_from(">I", ask.shown, 4) for ask in model.asks] == [(0,), (4,)]


def test_steps_fail_at_once_until_a_model_joins(instance: str) -> None:
    with built(instance) as segment, Running(segment, "sim", remote()) as sim:
        begin = sim.next()
        assert (begin.cycle, begin.quality) == (0, Quality.BAD)
        assert begin.reason.startswith(f'{NOBODY}; connect one with simulate("sim", …)')
        coordinator = Coordinator(segment)
        for number in (1, 2):
            with pytest.raises(TimeError, match=f"^step {number}: sim: {NOBODY}"):
                coordinator.step()
        with Model(instance):
            joined = good(sim)
            assert (joined.cycle, summed(joined)) == (2, 0), "the source is good as soon as a model has joined"
            coordinator.step()
            assert summed(latest(segment, "sim")) == 1
        while sim.next().quality is not Quality.BAD:
            pass
        with pytest.raises(TimeError, match=NOBODY):
            coordinator.step()
        with Model(instance):
            good(sim)
            coordinator.step()
            assert summed(latest(segment, "sim")) == 2, "the model continues from the shown value"


def test_failing_model_fails_the_step_with_its_reason(instance: str) -> None:
    def fails(ask: ModelRequest) -> bytes | str:
        return {2: "no solution", 3: ""}.get(ask.step, "") if ask.step in (2, 3) else add(ask)

    with built(instance) as segment, Running(segment, "sim", remote()) as sim, Model(instance, fails):
        good(sim)
        coordinator = Coordinator(segment)
        coordinator.step()
        with pytest.raises(TimeError, match=r"^step 2: sim: model 'adder': no solution$"):
            coordinator.step()
        with pytest.raises(TimeError, match=r"^step 3: sim: model 'adder': it failed without giving a reason$"):
            coordinator.step()
        assert summed(latest(segment, "sim")) == 1
        coordinator.step()
        assert summed(latest(segment, "sim")) == 2


def test_late_answer_is_not_used_for_another_step(instance: str) -> None:
    late = threading.Event()
    hold = threading.Event()

    def slow(ask: ModelRequest) -> bytes:
        if ask.step == 1:
            assert hold.wait(PATIENCE_S)
            late.set()
        return struct.pack(">III", 1000 * ask.step, 0, 0)

    with built(instance) as segment, Running(segment, "sim", remote(timeout_ms=50)) as sim:
        with Model(instance, slow) as model:
            good(sim)
            coordinator = Coordinator(segment)
            with pytest.raises(TimeError, match="sim: model 'adder' did not answer within 50 ms; check whether"):
                coordinator.step()
            hold.set()
            assert late.wait(PATIENCE_S)
            while model.link.answered.head() == 0:
                model.link.answered.wait(model.link.answered.doorbell(), 1 * MS)
            with suppress(TimeError):  # it may also time out, on a busy machine
                number = coordinator.step().number
                assert summed(latest(segment, "sim")) == 1000 * number
        assert all(summed(frame) != 1000 for frame in sim.frames())


def test_model_that_leaves_within_a_step_fails_the_step(instance: str) -> None:
    with built(instance) as segment, Running(segment, "sim", remote()) as sim:
        coordinator = Coordinator(segment)
        with Model(instance, lambda _: None) as model:
            good(sim)
            thread, errors = failing(coordinator.step)
            assert model.reached.wait(PATIENCE_S)
        thread.join()
        assert errors == [
            "step 1: sim: model 'adder' disconnected before it answered; the next step works once a model is connected"
        ]
        with Model(instance):
            good(sim)
            coordinator.step()
            assert summed(latest(segment, "sim")) == 1


def test_model_that_joins_within_a_step_does_not_replace_the_one_that_was_asked(instance: str) -> None:
    with built(instance) as segment, Running(segment, "sim", remote()) as sim, ExitStack() as stack:
        coordinator = Coordinator(segment)
        with Model(instance, lambda _: None) as model:
            good(sim)
            thread, errors = failing(coordinator.step)
            assert model.reached.wait(PATIENCE_S)
        other = stack.enter_context(Model(instance, name="other"))
        thread.join()
        assert "model 'adder' disconnected before it answered" in errors[0]
        assert other.asks == []
        coordinator.step()
        assert [ask.step for ask in other.asks] == [2]


def test_killed_model_fails_the_step(instance: str) -> None:
    with built(instance) as segment, Running(segment, "sim", remote()) as sim:
        with subprocess.Popen([sys.executable, "-c", MUTE, instance], stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline() == "joined\n"
                segment.clock.slot_bell(segment.processes.find("sim").index).ring()
                good(sim)
                thread, errors = failing(Coordinator(segment).step)
                assert process.stdout.readline() == "asked\n"
            finally:
                process.kill()
        thread.join()
        assert "model 'mute' disconnected before it answered" in errors[0]


def test_successor_of_the_source_continues_with_the_registers(instance: str) -> None:
    with built(instance) as segment, Model(instance) as model:
        coordinator = Coordinator(segment)
        with Running(segment, "sim", remote()) as sim:
            good(sim)
            for _ in range(2):
                coordinator.step()
        with Running(segment, "sim", remote()) as sim:
            assert (summed(frame := sim.next()), frame.quality) == (2, Quality.GOOD)
            coordinator.step()
            assert summed(latest(segment, "sim")) == 3
        assert [ask.step for ask in model.asks] == [1, 2, 3]


def test_stopping_source_waits_for_no_answer(instance: str) -> None:
    source = remote()
    with built(instance) as segment, Model(instance, lambda _: None) as model:
        with Running(segment, "sim", source) as sim:
            good(sim)
            thread, errors = failing(Coordinator(segment).step)
            assert model.reached.wait(PATIENCE_S)
            source.interrupt()
            thread.join()
        assert errors == ["step 1: sim: the source was stopped"]


def test_connected_inputs_and_their_doubt_reach_the_model(instance: str) -> None:
    with (
        built(instance) as segment,
        Running(segment, "sim", remote(other="cell/sum")) as sim,
        Model(instance) as model,
    ):
        good(sim)
        coordinator, cell = Coordinator(segment), segment.writer("cell")
        coordinator.step()
        frame = latest(segment, "sim")
        assert (frame.quality, frame.reason) == (Quality.UNCERTAIN, model.asks[0].doubt)
        assert frame.reason == "input other keeps its value: cell: no data yet"
        cell.publish(struct.pack(">III", 10, 0, 0), cycle=1)
        coordinator.step()
        assert struct.unpack(">III", latest(segment, "sim").raw) == (12, 0, 10)
        assert model.asks[1].doubt == ""


# ---- wall time -------------------------------------------------------------------------------------------------------


def test_model_is_asked_once_a_period_in_wall_time(instance: str) -> None:
    with built(instance, stepped=False) as segment, Running(segment, "sim", remote()) as sim:
        assert sim.next().reason.startswith(NOBODY)
        with Model(instance) as model:
            frames = [good(sim) for _ in range(5)]
            assert sim.loop.counters.failures > 0
        assert all(ask.dt_ns % PERIOD_NS == 0 for ask in model.asks)
        assert [frame.cycle * PERIOD_NS for frame in frames] == [ask.time_ns for ask in model.asks[:5]]
        assert [summed(frame) for frame in frames] == [1, 2, 3, 4, 5]
        while sim.next().quality is not Quality.BAD:
            pass


# ---- configuration ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "outputs: name the registers"),
        ({"outputs": ["total"]}, "outputs: 'total' matches no register of model"),
        ({"outputs": ["sum"], "timeout_ms": 0}, "timeout_ms"),
        ({"outputs": ["sum"], "timeout_ms": 10_000}, "timeout_ms"),
        ({"outputs": "sum"}, "outputs"),
    ],
)
def test_invalid_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        registry.load("remote")(registry.convert_options("remote", options), LAYOUT)
    assert str(caught.value).startswith(message)


def test_a_block_without_a_link_is_refused(instance: str) -> None:
    with built(instance) as segment, pytest.raises(SegmentError, match="source cell: its block has no link"):
        remote().attach(segment.writer("cell"))
