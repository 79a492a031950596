"""The invariants of steps: a step is complete, or names the cause of its failure."""

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
    """Shows the count of the other model before the step."""

    lead = Input("LINT")
    seen = Output("LINT")
    at_s = Output("LREAL")

    def step(self, time_s, dt_s):
        self.seen, self.at_s = self.lead, time_s
'''
PARTICIPANTS: Final = ("lead", "follow", "panel")
DISPATCHERS: Final = ("grpc", "recorder")
NAMED: Final = re.compile(rf"\b({'|'.join(PARTICIPANTS + DISPATCHERS)})\b|another program \(pid \d+\)")
"""Causes that a failed step may name: a process that did not complete the step, or the owner of time."""


class Answer(NamedTuple):
    """A participant's frame for a step."""

    cycle: int
    clock_ns: int
    quality: Quality
    values: Mapping[str, object]


@dataclass
class StepCheck:
    """Checks the steps of a program that is the only one to move time."""

    complain: Complain

    def done(self, before: Clock, number: int, dt_ns: int, after: Clock, answers: Mapping[str, Answer]) -> None:
        """Check a step that was done.

        Args:
            before: The clock page before the call.
            number: The step's number, as the call returned it.
            dt_ns: Length of the step.
            after: The clock page after the call.
            answers: The frame of each source for the step.
        """
        self._page(before, after, dt_ns)
        if number != after.step or after.done != number or after.step != before.step + 1:
            self._say(before, after, f"step {number} is reported as done")
        for name in PARTICIPANTS:
            answer = answers.get(name)
            if answer is None or answer.cycle != number:
                self._say(before, after, f"step {number} is reported as done, but {name} has no frame for it")
            elif answer.quality is Quality.BAD:
                self._say(before, after, f"step {number} is reported as done, but {name} is bad in it")
            elif answer.clock_ns != after.time_ns:
                self._say(before, after, f"{name} has the time {answer.clock_ns} for step {number}")
            elif "at_s" in answer.values and answer.values["at_s"] != after.time_ns / 1e9:
                self._say(before, after, f"{name} has computed step {number} for {answer.values['at_s']} s")
        if lead := answers.get("lead"):
            follow = answers.get("follow")
            # If its input was bad in the step before, it kept the old value and is uncertain.
            if follow and follow.quality is Quality.GOOD and follow.values["seen"] != _before(lead.values["count"]):
                seen, counted = follow.values["seen"], lead.values["count"]
                self._say(before, after, f"follow has seen {seen} in step {number}, which made it {counted}")

    def failed(self, before: Clock, text: str, dt_ns: int, after: Clock) -> None:
        """Check a step that failed with this message."""
        if not NAMED.search(text):
            self._say(before, after, f"the message of a failed step names no cause: {text}")
        self.unclear(before, dt_ns, after)

    def unclear(self, before: Clock, dt_ns: int, after: Clock) -> None:
        """Check a step of which it is unknown whether it was done."""
        if after.step not in (before.step, before.step + 1):
            self._say(before, after, "one step has used up more than its number")
        if after.done not in (before.done, after.step):
            self._say(before, after, "a step that nobody requested is done")
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
    """Checks the recording of one run of a stepped instance against the steps that were done."""

    complain: Complain

    def check(
        self,
        done: set[int],
        failed: set[int],
        marks: set[int],
        cycles: Mapping[str, set[int]],
        missed: Mapping[str, int],
    ) -> None:
        """Check the recording of a run.

        Args:
            done: Numbers of the steps that were reported as done.
            failed: Numbers of the steps that failed.
            marks: Numbers of the steps that are recorded as done.
            cycles: Cycles of the recorded frames, by source.
            missed: Number of frames that the recording's gaps report, by source.
        """
        for name in PARTICIPANTS:
            lost = done - cycles.get(name, set())
            if len(lost) > missed.get(name, 0):
                some = sorted(lost)[:5]
                self.complain(
                    f"{len(lost)} frames of {name} are not recorded, of steps {some}, ..., but its gaps report "
                    f"{missed.get(name, 0)}"
                )
        if wrong := marks & failed:
            self.complain(f"failed steps {sorted(wrong)[:5]} are recorded as done")
