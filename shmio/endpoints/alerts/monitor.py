"""Follows the sources and processes that alerts watch, and creates a notice when an alert changes."""

from __future__ import annotations

import logging
import selectors
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Final

from shmio.config import Alert
from shmio.endpoints.alerts.lifecycle import Change, Lifecycle, Progress
from shmio.endpoints.alerts.notice import MAX_REASON, Notice
from shmio.endpoints.alerts.watching import Finding, ProcessWatch, QualityWatch, Watch, make_watch
from shmio.layout.topic import shorten
from shmio.model.clock import Clock
from shmio.segment import Block, Frame, Segment
from shmio.segment.block import FrameFollower, QualityChange
from shmio.segment.doorbell import TURN_NS, Relay
from shmio.times import utc_text

TURN_S: Final = TURN_NS / 1e9
LOOK_S: Final = 0.1
"""Interval in s at which the monitor checks the process table, because changes of the table ring no doorbell."""
CATCH_UP_S: Final = 2.0
"""If a source's unread frames span more than this time, in s, the monitor skips to the newest frame."""
BATCH: Final = 500
"""Maximum number of frames that one turn reads from a source."""

log = logging.getLogger("shmio.alerts")


class WatchedAlert:
    """An alert with its configuration, the thing that it watches, and its state."""

    def __init__(self, alert: Alert, progress: Progress, watch: Watch) -> None:
        self.alert = alert
        self.watch = watch
        self.seen: bool | None = None
        """The last result of evaluating the condition; None if it was unknown."""
        self.holds: bool | None = None
        """The last known result of the condition; None if it has never been known."""
        self.finding = Finding()
        """What the alert saw when :attr:`holds` last changed."""
        self.lifecycle = Lifecycle(round(alert.for_s * 1e9), round(alert.every_s * 1e9), alert.resolved, progress)

    @property
    def active(self) -> bool:
        """True if the alert is active."""
        return self.lifecycle.progress.active


class Monitor:
    """Evaluates all alerts. Use it from one thread."""

    def __init__(
        self,
        segment: Segment,
        alerts: Sequence[Alert],
        progress: Mapping[str, Progress],
        selector: selectors.BaseSelector,
    ) -> None:
        """Start following the sources that the alerts watch.

        Args:
            segment: The instance's segment.
            alerts: The alerts.
            progress: The state that an earlier process saved for its alerts, by name.
            selector: The monitor registers a descriptor for each source here. The descriptor
                becomes ready when the source publishes; the caller must then call the ``data`` of
                its key.

        """
        self._segment, self._selector = segment, selector
        self.alerts = [
            WatchedAlert(alert, progress.get(alert.title, Progress()), make_watch(alert, segment)) for alert in alerts
        ]
        self.changed = True
        """True once the state of an alert has changed, until the caller resets it."""
        self.suppressed = 0
        """Number of suppressed activations that notices have reported since the process started."""
        self.done = 0
        """Number of the last step of virtual time of which all frames have been evaluated."""
        self._missed = 0
        self._followers: dict[str, FrameFollower] = {}
        self._relays: dict[int, Relay] = {}
        self._blocks: Mapping[str, Block] = {}
        self._looked_s = 0.0
        self._now_ns = 0
        self._follow()

    @property
    def missed(self) -> int:
        """Number of frames that were overwritten or skipped before the monitor could evaluate them."""
        return self._missed + sum(follower.missed for follower in self._followers.values())

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks that the monitor follows, each with the number of the last frame that it has read."""
        return ((follower.block, follower.last) for follower in self._followers.values())

    def run_once(self) -> tuple[list[tuple[WatchedAlert, Notice]], bool]:
        """Evaluate new frames and process states.

        Returns:
            The new notices with their alerts, and whether more frames are waiting.
        """
        clock = self._segment.clock.read()  # before the frames, so that they include all of a finished step
        if self._segment.refresh() or self._blocks is not self._segment.blocks:
            self._bind()
        self._now_ns = clock.present_ns
        notices: list[tuple[WatchedAlert, Notice]] = []
        frames, more = self._read()
        for source, frame in frames:
            notices += self._take(source, frame, self._time_ns(source, frame, clock))
        for source, follower in self._followers.items():
            if follower.became_stale():
                notices += self._evaluate(self._concerned[source], self._now_ns)
        notices += self._check_processes()
        if not more:
            self.done = clock.done
            for one in self.alerts:
                notices += self._notices(one, one.lifecycle.advance(self._now_ns), self._now_ns)
        return notices, more

    def pause_s(self) -> float:
        """Return the maximum time in s to wait before the next :meth:`run_once` if no source publishes a frame."""
        clock = self._segment.clock.read()
        due_ns = min((due for one in self.alerts if (due := one.lifecycle.due_ns) is not None), default=None)
        if due_ns is None or clock.virtual:
            return TURN_S
        return min(TURN_S, max(0.0, (due_ns - clock.present_ns) / 1e9))

    def close(self) -> None:
        """Stop following the sources."""
        for relay in self._relays.values():
            self._selector.unregister(relay.descriptor)
            relay.stop()
        for relay in self._relays.values():
            relay.join()
        self._relays.clear()

    # ---- frames ------------------------------------------------------------------------------------------------------

    def _bind(self) -> None:
        """Look up registers and sources again after a reload."""
        for one in self.alerts:
            if not isinstance(one.watch, ProcessWatch):
                one.watch = make_watch(one.alert, self._segment)
        self._follow()

    def _follow(self) -> None:
        self._blocks = self._segment.blocks
        wanted = {source for one in self.alerts for source in one.watch.sources}
        self._concerned = {source: [one for one in self.alerts if source in one.watch.sources] for source in wanted}
        for source, follower in list(self._followers.items()):
            if source not in wanted or self._blocks.get(source) is not follower.block:
                self._missed += self._followers.pop(source).missed
                relay = self._relays.pop(follower.block.section)
                self._selector.unregister(relay.descriptor)
                relay.stop()
        for source in wanted - self._followers.keys():
            block = self._blocks[source]
            self._followers[source] = FrameFollower(block, catch_up_s=CATCH_UP_S, notice_gaps=True)
            relay = self._relays[block.section] = Relay(block.ring, f"alerts-{source}", min(TURN_NS, block.stale_ns))
            self._selector.register(relay.descriptor, selectors.EVENT_READ, partial(_heard, relay))

    def _read(self) -> tuple[list[tuple[str, Frame]], bool]:
        """Return the new frames of all sources in the order of their publication, and whether there are more."""
        frames: list[tuple[str, Frame]] = []
        more = False
        for source, follower in self._followers.items():
            taken = list(follower.read(BATCH))
            more |= len(taken) == BATCH
            frames += ((source, frame) for frame in taken)
        frames.sort(key=lambda one: one[1].publish_ns)  # stable: frames of a source stay in order
        return frames, more

    def _time_ns(self, source: str, frame: Frame, clock: Clock) -> int:
        """Return the instance time at which to evaluate a frame: usually the frame's own time.

        Two kinds of frames are evaluated at the present time. Frames of a replay may have times of
        the recording. Frames of devices do not follow the instance's clock once it was stepped.
        """
        block = self._followers[source].block
        follows = block.attributes.stepped if clock.virtual or clock.offset_ns else True
        if not follows or block.playhead is not None:
            return self._now_ns
        return min(frame.clock_ns, self._now_ns)

    def _take(self, source: str, frame: Frame, now_ns: int) -> Iterator[tuple[WatchedAlert, Notice]]:
        follower = self._followers[source]
        last, change = follower.frame, follower.take(frame, aged=False)
        for one in self._concerned[source]:
            if isinstance(one.watch, QualityWatch):
                if change is not QualityChange.NONE:
                    yield from self._evaluate([one], now_ns)
                continue
            if change is QualityChange.GAP and last is not None:
                stale_ns = now_ns - (frame.publish_ns - last.publish_ns) + follower.block.stale_ns
                one.seen = None
                yield from self._notices(one, one.lifecycle.observe(None, stale_ns), stale_ns)
            yield from self._evaluate([one], now_ns)

    def _check_processes(self) -> list[tuple[WatchedAlert, Notice]]:
        """Evaluate the alerts that watch processes, or the quality of sources without a frame."""
        now_s = time.monotonic()
        if now_s < self._looked_s + LOOK_S:
            return []
        self._looked_s = now_s
        silent = {source for source, follower in self._followers.items() if follower.frame is None}
        watched = [
            one
            for one in self.alerts
            if isinstance(one.watch, ProcessWatch)
            or (isinstance(one.watch, QualityWatch) and not silent.isdisjoint(one.watch.sources))
        ]
        return list(self._evaluate(watched, self._now_ns))

    # ---- notices -----------------------------------------------------------------------------------------------------

    def _evaluate(self, alerts: Iterable[WatchedAlert], now_ns: int) -> Iterator[tuple[WatchedAlert, Notice]]:
        for one in alerts:
            holds = one.watch.evaluate(self._followers)
            if holds is one.seen and one.lifecycle.due_ns is None:
                continue  # nothing has changed, as at almost every frame
            one.seen = holds
            if holds is not None and holds is not one.holds:
                one.holds, one.finding = holds, one.watch.describe(self._followers)
            yield from self._notices(one, one.lifecycle.observe(holds, now_ns), now_ns)

    def _notices(
        self, one: WatchedAlert, changes: Iterator[Change], now_ns: int
    ) -> Iterator[tuple[WatchedAlert, Notice]]:
        progress = one.lifecycle.progress
        before = progress.active, progress.suppressed
        for change in changes:
            self.changed = True
            yield one, self._notice(one, change, now_ns)
        if (progress.active, progress.suppressed) != before:
            self.changed = True
            self._log(one, was_active=before[0])

    def _log(self, one: WatchedAlert, *, was_active: bool) -> None:
        progress, name = one.lifecycle.progress, one.alert.title
        if progress.active and not was_active:
            waits = "" if progress.announced else f"; its notice waits for every_s = {one.alert.every_s:g}"
            log.warning("alert %s is active: %s%s", name, one.finding.reason, waits)
        elif was_active and not progress.active:
            log.info("alert %s has ended: %s", name, one.finding.reason)

    def _notice(self, one: WatchedAlert, change: Change, now_ns: int) -> Notice:
        alert, progress, finding = one.alert, one.lifecycle.progress, one.finding
        self.suppressed += progress.suppressed if change is Change.ACTIVE else 0
        return Notice(
            id=f"{self._segment.instance}-{self._segment.header.epoch:x}-{alert.title}-{progress.notices}",
            instance=self._segment.instance,
            alert=alert.title,
            state=change,
            severity=alert.severity,
            text=alert.text,
            watches=alert.watches,
            reason=shorten(finding.reason, MAX_REASON),
            values=dict(finding.values),
            injected=finding.injected,
            provenance=finding.provenance,
            clock_s=now_ns / 1e9,
            since_s=progress.since_ns / 1e9,
            time=utc_text(time.time(), "milliseconds"),
            suppressed=progress.suppressed,
        )


def _heard(relay: Relay, _events: int) -> None:
    relay.acknowledge()
