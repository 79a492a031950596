"""A stepped instance, whose frames the test publishes, and its monitor."""

from __future__ import annotations

import selectors
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from shmio.config import Alert
from shmio.endpoints.alerts.lifecycle import Change, Progress
from shmio.endpoints.alerts.monitor import Monitor
from shmio.endpoints.alerts.notice import Notice
from shmio.model.clock import Clock, ClockMode
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Quality, Segment
from shmio.segment.block import Stamp
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, image


def notice(alert: str = "hot", number: int = 1, state: Change = Change.ACTIVE) -> Notice:
    return Notice(
        id=f"a-1-{alert}-{number}", instance="a", alert=alert, state=state, severity="warning", text="Too hot",
        watches="cell/axis/position > 5", reason="cell/axis/position = 6.0", values={"cell/axis/position": 6.0},
        injected=False, provenance="live", clock_s=1.0, since_s=1.0, time="2026-01-01T00:00:00.000Z", suppressed=0,
    )  # fmt: skip


class Watched:
    """A monitor over sources that use the instance's clock."""

    def __init__(self, segment: Segment, alerts: list[Alert], progress: Mapping[str, Progress]) -> None:
        self.segment = segment
        self.selector = selectors.DefaultSelector()
        self.monitor = Monitor(segment, alerts, progress, self.selector)
        self.writers = {name: segment.writer(name) for name in segment.blocks}
        self.step = 0

    def at(self, time_s: float, source: str = "cell", quality: Quality = Quality.GOOD, **values: Any) -> list[Notice]:
        """Set the clock, publish a frame, and return the notices that follow."""
        self.publish(time_s, source, quality, **values)
        return self.until(time_s)

    def publish(
        self, time_s: float, source: str = "cell", quality: Quality = Quality.GOOD, *, effective: bytes | None = None,
        **values: Any,
    ) -> None:  # fmt: skip
        now_ns = round(time_s * 1e9)
        stamp = Stamp(self.segment.clock.monotonic_ns(now_ns), now_ns, 1)
        self.step += 1
        self.writers[source].publish(image(**values), cycle=self.step, quality=quality, effective=effective, at=stamp)

    def until(self, time_s: float) -> list[Notice]:
        """Set the clock, and return the notices that follow."""
        self.segment.clock.write(Clock(ClockMode.VIRTUAL, self.step, round(time_s * 1e9), done=self.step))
        return self.run_once()

    def run_once(self) -> list[Notice]:
        found, more = self.monitor.run_once()
        while more:
            rest, more = self.monitor.run_once()
            found += rest
        return [one for _, one in found]


@contextmanager
def watched(
    instance: str, *alerts: Alert, progress: Mapping[str, Progress] | None = None, sources: tuple[str, ...] = ("cell",)
) -> Iterator[Watched]:
    attributes = Attributes("simulation", stepped=True)
    blocks = [BlockSpec(name, LAYOUT, 20_000_000, STALE_NS, 1 << 20, attributes) for name in sources]
    processes = [*(ProcessSpec(name, "source") for name in sources), ProcessSpec("alerts", "alerts")]
    with Segment.create(instance, blocks, processes, stepped=True) as segment:
        one = Watched(segment, [*alerts], progress or {})
        try:
            yield one
        finally:
            one.monitor.close()
            one.selector.close()
            segment.unlink()
