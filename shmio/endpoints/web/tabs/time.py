"""The time tab: steps, plays, pauses and releases the instance's clock."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta
from starlette.concurrency import run_in_threadpool

from shmio.endpoints.web.page import Nothing, Tab, call
from shmio.model.clock import Clock

MAX_STEPS: Final = 10_000
"""Maximum number of steps in one call."""

_Seconds = Annotated[float, Meta(ge=1e-6, le=3600)]


class Steps(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``step``: the number of steps, and the length of each in s; None for the step size."""

    count: Annotated[int, Meta(ge=1, le=MAX_STEPS)] = 1
    dt_s: _Seconds | None = None


class Rate(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``play``: the speed as a multiple of real time, and the length of each step in s.

    If the length is None, it is the step size.
    """

    rate: Annotated[float, Meta(gt=0, le=1000)] = 1.0
    dt_s: _Seconds | None = None


class Time(Tab):
    """Controls the instance's clock.

    Once a page has taken control of the clock, the process ``web`` owns it, so any page can
    continue.
    """

    name: ClassVar[str] = "time"

    @call("read", Nothing)
    async def state(self, _: Nothing) -> dict[str, Any]:
        """Return the state of the clock, and the sources that steps do not affect."""
        cell = self.page.served.cell
        return {"clock": _described(cell.clock), "real_sources": cell.real_sources()}

    @call("control", Steps)
    async def step(self, given: Steps) -> dict[str, Any]:
        """Step virtual time. Return the state of the clock after the last step."""
        return _described(await run_in_threadpool(self.page.served.cell.step, given.dt_s, given.count))

    @call("control", Rate)
    async def play(self, given: Rate) -> dict[str, Any]:
        """Play virtual time until it is paused. Return the state of the clock."""
        return _described(await run_in_threadpool(self.page.served.cell.play, given.rate, given.dt_s))

    @call("control", Nothing)
    async def pause(self, _: Nothing) -> dict[str, Any]:
        """Pause virtual time. Return the state of the clock."""
        return _described(await run_in_threadpool(self.page.served.cell.pause))

    @call("control", Nothing)
    async def release(self, _: Nothing) -> dict[str, Any]:
        """Release the clock, so that time is real again. Return the state of the clock."""
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
