"""Doorbells of blocks, which wake listeners in the event loop."""

from __future__ import annotations

import asyncio
import select

import pytest

from shmio.endpoints.grpc.wakeups import WakeUp, WakeUps
from shmio.segment import Segment
from tests.unit.endpoints.harness import TIMEOUT_S, image


def test_listeners_of_a_block_are_called_in_the_order_of_joining(segment: Segment) -> None:
    async def test() -> None:
        block, writer, wake_ups = segment.blocks["cell"], segment.writer("cell"), WakeUps()
        heard = list[tuple[str, int]]()
        reached = asyncio.Event()

        def first() -> None:
            heard.append(("first", block.ring.head()))

        def second() -> None:
            heard.append(("second", block.ring.head()))
            if block.ring.head() == 100:
                reached.set()

        wake_ups.join(block, first)
        wake_ups.join(block, second)
        for number in range(100):
            writer.publish(image(step=number), cycle=number)
        async with asyncio.timeout(TIMEOUT_S):
            await reached.wait()
        assert heard[-2:] == [("first", 100), ("second", 100)]
        assert len(heard) < 200, "a busy event loop is not woken for each frame"
        wake_ups.leave(block, first)
        heard.clear()
        reached.clear()
        writer.publish(image(), cycle=100)
        async with asyncio.timeout(TIMEOUT_S):
            while ("second", 101) not in heard:  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(0)
        assert ("first", 101) not in heard
        wake_ups.close()

    asyncio.run(test())


def test_a_listener_that_leaves_during_a_ring_leaves_others_listening(segment: Segment) -> None:
    async def test() -> None:
        block, wake_ups, over = segment.blocks["cell"], WakeUps(), asyncio.Event()

        def leaving() -> None:
            wake_ups.leave(block, leaving)

        wake_ups.join(block, leaving)
        wake_ups.join(block, over.set)
        async with asyncio.timeout(TIMEOUT_S):
            await over.wait()
        wake_ups.leave(block, over.set)
        wake_ups.close()

    asyncio.run(test())


def test_a_bell_rests_while_all_listeners_are_patient(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.wakeups.PAUSE_S", 1000.0)

    async def test() -> None:
        block, writer, wake_ups = segment.blocks["cell"], segment.writer("cell"), WakeUps()
        heard = list[str]()
        rung = asyncio.Event()

        def busy() -> None:
            heard.append("busy")

        def patient() -> None:
            heard.append("patient")

        def prompt() -> None:
            heard.append("prompt")
            rung.set()

        wake_ups.join(block, busy)
        wake_ups.join(block, patient, patient=True)
        wake_ups.pause(block, busy)
        heard.clear()
        for number in range(100):
            writer.publish(image(step=number), cycle=number)
            await asyncio.sleep(0)
        assert not heard
        wake_ups.join(block, prompt)  # an impatient listener ends the pause for all
        async with asyncio.timeout(TIMEOUT_S):
            await rung.wait()
            assert heard == ["busy", "patient", "prompt"]
            wake_ups.pause(block, busy)
            rung.clear()
            writer.publish(image(), cycle=100)
            await rung.wait()
            wake_ups.leave(block, prompt)
            wake_ups.pause(block, busy)
            heard.clear()
            wake_ups.resume(block, busy)
            while not heard:  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(0)
            wake_ups.pause(block, patient)  # busy is still to be woken
            heard.clear()
            writer.publish(image(), cycle=101)
            while not heard:  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(0)
        wake_ups.close()

    asyncio.run(test())


@pytest.mark.parametrize("pauses_first", [True, False])
def test_a_muted_bell_has_no_pause_that_would_end_its_silence(segment: Segment, pauses_first: bool) -> None:
    async def test() -> None:
        heard = asyncio.Event()
        bell = WakeUp(segment.blocks["cell"].ring, "bell", turn_ns=10**15)
        bell.listeners[heard.set] = None
        bell.patient.add(heard.set)
        try:
            for act in (bell.pause, bell.mute) if pauses_first else (bell.mute, bell.pause):
                act()
            bell.resume()
            segment.writer("cell").publish(image(), cycle=1)
            assert select.select([bell._relay.descriptor], [], [], TIMEOUT_S)[0]
            for _ in range(3):
                await asyncio.sleep(0)
            assert not heard.is_set()
            bell.unmute()
            async with asyncio.timeout(TIMEOUT_S):
                await heard.wait()
        finally:
            bell.stop()
            bell.join()

    asyncio.run(test())


def test_a_bell_that_has_rested_rings_once_and_continues(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.wakeups.PAUSE_S", 0.001)

    async def test() -> None:
        writer, heard = segment.writer("cell"), asyncio.Event()
        bell = WakeUp(segment.blocks["cell"].ring, "bell", turn_ns=10**15)
        bell.listeners[heard.set] = None
        bell.patient.add(heard.set)

        async def rings() -> None:
            async with asyncio.timeout(TIMEOUT_S):
                await heard.wait()
            heard.clear()

        await rings()
        bell.pause()
        await rings()  # though no frame was published since
        writer.publish(image(), cycle=1)
        await rings()
        bell.stop()
        writer.publish(image(), cycle=2)  # wakes its thread
        bell.join()

    asyncio.run(test())
