"""Wakes the event loop when a block has new frames or events, and reads them in batches."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Final

from shmio.segment import Block
from shmio.segment.doorbell import TURN_NS, Relay, WakeSource

log = logging.getLogger("shmio.grpc")

Callback = Callable[[], object]

PAUSE_S: Final = 0.02
"""Length of a pause between wake-ups in which all listeners are patient, in s."""


class WakeUp:
    """Calls its listeners when a word in shared memory has changed.

    It also calls them at the start, and after ``turn_ns`` without a change. Use it only in the
    event loop's thread.
    """

    def __init__(self, word: WakeSource, name: str, turn_ns: int = TURN_NS) -> None:
        """Start waiting for changes.

        Args:
            word: The word in shared memory.
            name: Name of the thread that waits.
            turn_ns: Maximum time between two calls, in ns.

        """
        self.listeners: dict[Callback, None] = {}  # in the order in which they came
        self.patient: set[Callback] = set()
        """Listeners that can wait during a pause."""
        self._loop = asyncio.get_running_loop()
        self._relay = Relay(word, name, turn_ns)
        self._pausing: asyncio.TimerHandle | None = None
        self._muted = True
        self.unmute()

    @property
    def alive(self) -> bool:
        """True while the thread that waits for changes is running."""
        return self._relay.alive

    def mute(self) -> None:
        """Stop calling the listeners. After :meth:`unmute`, one call makes up for the calls that they missed."""
        self.resume()
        self._muted = True
        self._loop.remove_reader(self._relay.descriptor)

    def unmute(self) -> None:
        """Call the listeners again."""
        self._muted = False
        self._loop.add_reader(self._relay.descriptor, self._ring)

    def pause(self) -> None:
        """If all listeners are patient, stop calling them for ``PAUSE_S``."""
        if not self._muted and self.patient >= self.listeners.keys():
            self.mute()
            self._pausing = self._loop.call_later(PAUSE_S, self._pause_over)

    def _pause_over(self) -> None:
        """End the pause, and call the listeners."""
        self.resume()
        for ring in tuple(self.listeners):
            ring()

    def resume(self) -> None:
        """End the pause."""
        if self._pausing is not None:
            self._pausing.cancel()
            self._pausing = None
            self.unmute()

    def stop(self) -> None:
        """Stop calling the listeners, and make the thread end."""
        self.mute()
        self._relay.stop()

    def join(self) -> None:
        """Wait until the thread has ended. Call :meth:`stop` first."""
        self._relay.join()

    def _ring(self) -> None:
        self._relay.acknowledge()
        for ring in tuple(self.listeners):
            ring()


class WakeUps:
    """The wake-ups of all blocks that are being followed. Use it only in the event loop's thread."""

    def __init__(self) -> None:
        self._wake_ups: dict[int, WakeUp] = {}
        self._stopped: list[WakeUp] = []

    def join(self, block: Block, ring: Callback, *, patient: bool = False) -> None:
        """Call ``ring`` when the block has a new frame or event, and also periodically.

        Args:
            block: The block.
            ring: The listener.
            patient: Whether the listener can wait. If all listeners can, the wake-ups pause.

        """
        wake_up = self._wake_ups.get(block.section)
        if wake_up is None:
            wake_up = WakeUp(block.ring, f"bell-{block.source}", min(TURN_NS, block.stale_ns))
            self._wake_ups[block.section] = wake_up
        wake_up.listeners[ring] = None
        if patient:
            wake_up.patient.add(ring)
        else:
            wake_up.resume()

    def pause(self, block: Block, ring: Callback) -> None:
        """Mark ``ring`` as patient.

        The wake-ups pause while all listeners of the block are patient.
        """
        if wake_up := self._wake_ups.get(block.section):
            wake_up.patient.add(ring)
            wake_up.pause()

    def end_pause(self, block: Block) -> None:
        """End a pause of the block's wake-ups. The listeners stay as patient as they were."""
        if wake_up := self._wake_ups.get(block.section):
            wake_up.resume()

    def resume(self, block: Block, ring: Callback) -> None:
        """Mark ``ring`` as no longer patient."""
        if wake_up := self._wake_ups.get(block.section):
            wake_up.patient.discard(ring)
            wake_up.resume()

    def leave(self, block: Block, ring: Callback) -> None:
        """Remove ``ring``. When a block's last listener is removed, its wake-up ends."""
        wake_up = self._wake_ups.get(block.section)
        if wake_up is None:
            return  # close() was called before
        wake_up.listeners.pop(ring, None)
        wake_up.patient.discard(ring)
        if not wake_up.listeners:
            wake_up.stop()
            del self._wake_ups[block.section]
            self._stopped = [stopped for stopped in self._stopped if stopped.alive] + [wake_up]

    def close(self) -> None:
        """Stop all wake-ups and wait for their threads."""
        for wake_up in self._wake_ups.values():
            wake_up.stop()
        for wake_up in (*self._wake_ups.values(), *self._stopped):
            wake_up.join()
        self._wake_ups.clear()


class BatchReader:
    """Reads a block's frames or events in batches, at each wake-up.

    Between two batches, the event loop serves the streams. Use it only in the event loop's thread.
    """

    def __init__(
        self,
        block: Block,
        wake_ups: WakeUps,
        read: Callable[[], bool],
        *,
        passes: Callable[[], bool] | None = None,
        patient: bool = False,
    ) -> None:
        """Prepare to read. :meth:`start` starts reading.

        Args:
            block: The block to read.
            wake_ups: Wakes this reader.
            read: Reads a batch, and returns whether more is waiting.
            passes: Returns whether to read nothing now. If so, the reader is patient until
                :meth:`resume`. If ``passes`` is None, the reader reads at each wake-up.
            patient: See :meth:`WakeUps.join`.

        """
        self.alive = False
        """True while the reader follows the block."""
        self._block = block
        self._wake_ups = wake_ups
        self._read = read
        self._passes = passes
        self._patient = patient
        self._loop = asyncio.get_running_loop()
        self._again = False  # whether another read is scheduled

    def start(self) -> None:
        """Start following the block."""
        self.alive = True
        self._wake_ups.join(self._block, self.read_batch, patient=self._patient)

    def stop(self) -> None:
        """Stop following the block."""
        if self.alive:
            self.alive = False
            self._wake_ups.leave(self._block, self.read_batch)

    def read_batch(self) -> None:
        """Read a batch, unless ``passes`` says to read nothing now."""
        if not self.alive:
            return  # stopped during the wake-up
        if self._passes is not None and self._passes():
            self.pause()
        else:
            self.read()

    def read(self) -> None:
        """Read a batch now. If more is waiting, read on once the streams have been served."""
        try:
            more = self._read()
        except Exception:
            log.exception("the endpoint can no longer follow source %s", self._block.source)
            self.stop()
            return
        if more and not self._again:
            self._again = True
            self._loop.call_soon(self._look_again)

    def pause(self) -> None:
        """Make the reader patient until :meth:`resume`, and pause the wake-ups if all listeners are patient."""
        self._wake_ups.pause(self._block, self.read_batch)

    def end_pause(self) -> None:
        """End a pause of the wake-ups, because news will come that cannot wait."""
        self._wake_ups.end_pause(self._block)

    def resume(self) -> None:
        """Make the reader read at each wake-up again, because it is no longer patient."""
        self._wake_ups.resume(self._block, self.read_batch)

    def _look_again(self) -> None:
        self._again = False
        self.read_batch()
