"""The time tab: steps, plays, pauses and releases the time of the instance."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta
from starlette.concurrency import run_in_threadpool

from shmio.endpoints.web.page import Nothing, Tab, call
from shmio.model.clock import Clock

MAX_STEPS: Final = 10_000
"""Maximum number of steps of one call."""

_Seconds = Annotated[float, Meta(ge=1e-6, le=3600)]


class Steps(msgspec.Struct, forbid_unknown_fields=True):
    """Number of steps, and the length of each in s; None: the step size."""

    count: Annotated[int, Meta(ge=1, le=MAX_STEPS)] = 1
    dt_s: _Seconds | None = None


class Rate(msgspec.Struct, forbid_unknown_fields=True):
    """Speed relative to real time, and the length of a step in s; None: the step size."""

    rate: Annotated[float, Meta(gt=0, le=1000)] = 1.0
    dt_s: _Seconds | None = None


class Time(Tab):
    """Controls time. The process ``web`` owns the time that a page has taken over, so any page can go on with it."""

    name: ClassVar[str] = "time"

    @call("read", Nothing)
    async def state(self, _: Nothing) -> dict[str, Any]:
        """Return the clock, and the sources that steps do not affect."""
        cell = self.page.served.cell
        return {"clock": _described(cell.clock), "real_sources": cell.real_sources()}

    @call("control", Steps)
    async def step(self, given: Steps) -> dict[str, Any]:
        """Take steps; return the clock after the last one."""
        return _described(await run_in_threadpool(self.page.served.cell.step, given.dt_s, given.count))

    @call("control", Rate)
    async def play(self, given: Rate) -> dict[str, Any]:
        """Let time play until it is paused."""
        return _described(await run_in_threadpool(self.page.served.cell.play, given.rate, given.dt_s))

    @call("control", Nothing)
    async def pause(self, _: Nothing) -> dict[str, Any]:
        """Stop time."""
        return _described(await run_in_threadpool(self.page.served.cell.pause))

    @call("control", Nothing)
    async def release(self, _: Nothing) -> dict[str, Any]:
        """Return to real time."""
        return _described(await run_in_threadpool(self.page.served.cell.release))


def _described(clock: Clock) -> dict[str, Any]:
    return {
        "mode": str(clock.mode),
        "time_s": clock.present_ns / 1e9,
        "step": clock.step,
        "step_size_ms": clock.step_size_ns / 1e6,
        "playing": clock.playing,
        "rate": clock.rate,
        "stepping": clock.stepping,
        "owner": clock.owner,
        "note": clock.note,
    }
