"""The invariants of steps: one is done whole, or fails by name; the next one works, and time has one owner."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from shmio.model.clock import Clock
from shmio.segment import Quality
from tests.faults.checks import Complain

MODELS: Final = '''
from shmio.simulation import Input, Model, Output


class Lead(Model):
    """Counts its steps."""

    count = Output("LINT")
    at_s = Output("LREAL")

    def step(self, time_s, dt_s):
        self.count += 1
        self.at_s = time_s


class Follow(Model):
    """Shows what the other one had counted before the step."""

    lead = Input("LINT")
    seen = Output("LINT")
    at_s = Output("LREAL")

    def step(self, time_s, dt_s):
        self.seen, self.at_s = self.lead, time_s
'''
PARTICIPANTS: Final = ("lead", "follow", "panel")
DISPATCHERS: Final = ("grpc", "recorder")
NAMED: Final = re.compile(rf"\b({'|'.join(PARTICIPANTS + DISPATCHERS)})\b|another program \(pid \d+\)")
"""What a step that fails names: who has not done it, or who owns time."""


class Answer(NamedTuple):
    """A participant's frame for a step."""

    cycle: int
    clock_ns: int
    quality: Quality
    values: Mapping[str, object]


@dataclass
class StepCheck:
    """Holds the steps of a program that alone moves time to what is promised."""

    complain: Complain

    def done(self, before: Clock, number: int, dt_ns: int, after: Clock, answers: Mapping[str, Answer]) -> None:
        """A step is over: its number as the call told it, the page before and after, each source's frame for it."""
        self._page(before, after, dt_ns)
        if number != after.step or after.done != number or after.step != before.step + 1:
            self._say(before, after, f"step {number} is told to be done")
        for name in PARTICIPANTS:
            answer = answers.get(name)
            if answer is None or answer.cycle != number:
                self._say(before, after, f"step {number} is told to be done, but {name} has no frame for it")
            elif answer.quality is Quality.BAD:
                self._say(before, after, f"step {number} is told to be done, but {name} is bad in it")
            elif answer.clock_ns != after.time_ns:
                self._say(before, after, f"{name} has the time {answer.clock_ns} for step {number}")
            elif "at_s" in answer.values and answer.values["at_s"] != after.time_ns / 1e9:
                self._say(before, after, f"{name} has computed step {number} for {answer.values['at_s']} s")
        if lead := answers.get("lead"):
            follow = answers.get("follow")
            # One whose input was bad in the step before has kept what it had, and is uncertain.
            if follow and follow.quality is Quality.GOOD and follow.values["seen"] != _before(lead.values["count"]):
                seen, counted = follow.values["seen"], lead.values["count"]
                self._say(before, after, f"follow has seen {seen} in step {number}, which made it {counted}")

    def failed(self, before: Clock, text: str, dt_ns: int, after: Clock) -> None:
        """A step has failed with this text."""
        if not NAMED.search(text):
            self._say(before, after, f"a step has failed and names nobody: {text}")
        self.unclear(before, dt_ns, after)

    def unclear(self, before: Clock, dt_ns: int, after: Clock) -> None:
        """Nobody has told what became of a step: it was done, or not."""
        if after.step not in (before.step, before.step + 1):
            self._say(before, after, "one step has used up more than its number")
        if after.done not in (before.done, after.step):
            self._say(before, after, "a step that was not asked for is done")
        if after.step != before.step:
            self._page(before, after, dt_ns)

    def _page(self, before: Clock, after: Clock, dt_ns: int) -> None:
        if not (before.virtual and after.virtual):
            self._say(before, after, "time is not virtual")
        if after.time_ns != before.time_ns + dt_ns:
            self._say(before, after, f"a step of {dt_ns} ns does not lead there")

    def _say(self, before: Clock, after: Clock, problem: str) -> None:
        self.complain(f"{problem} (from {before} to {after})")


def _before(count: object) -> int:
    assert isinstance(count, int)
    return count - 1


@dataclass
class RecordedSteps:
    """Holds a recording of a stepped instance to the steps that were told to be done. Of one run of the instance."""

    complain: Complain

    def check(
        self,
        done: set[int],
        failed: set[int],
        marks: set[int],
        cycles: Mapping[str, set[int]],
        missed: Mapping[str, int],
    ) -> None:
        """``done``: steps that were told to be, ``failed``: not to be. ``marks``: those that it tells of.

        ``cycles``: of the frames in it, by source. ``missed``: frames that its gaps tell of.
        """
        for name in PARTICIPANTS:
            lost = done - cycles.get(name, set())
            if len(lost) > missed.get(name, 0):
                some = sorted(lost)[:5]
                self.complain(
                    f"{len(lost)} frames of {name} are not recorded, of steps {some}, ..., and its gaps tell of "
                    f"{missed.get(name, 0)}"
                )
        if wrong := marks & failed:
            self.complain(f"the recording tells that steps {sorted(wrong)[:5]} are done, which have failed")
