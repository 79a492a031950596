"""Searches the parameter space of a campaign for points at which an expectation fails.

Trials are numbered. The search learns their results in the order of the numbers. It chooses the
point of a trial when it has learned the results of all earlier trials except the last ``jobs - 1``.
So the trials depend on the seed and on ``jobs``, but never on how long they take.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from shmio.config.ranges import Point, Space
from shmio.errors import ConfigError, ModelError
from shmio.falsification.journal import Journal, Line
from shmio.falsification.pool import TrialPool
from shmio.falsification.search import Search
from shmio.falsification.shrink import Case, Shrinker
from shmio.falsification.trial import Result, Status, Task

LOOK_S: Final = 0.25
"""Maximum time in s between two checks whether the search has been asked to stop."""
FIRST_TRIALS: Final = 10
"""Number of trials at the beginning of a search; if all of them fail to run to their end, the search ends."""


@dataclass
class Tally:
    """What a search has found so far.

    Attributes:
        counts: Number of trials by status.
        best: Result of the best trial, the one with the least robustness; None if no trial has any.
        best_point: Point of the best trial.
        unclear: Result of the first trial that was inconclusive, or could not run; None if none was.
        simulated_s: Simulated time of all trials together, in s.
        done: Number of trials so far.

    """

    counts: dict[Status, int] = field(default_factory=dict)
    best: Result | None = None
    best_point: Point = field(default_factory=dict)
    unclear: Result | None = None
    simulated_s: float = 0.0
    done: int = 0

    def add(self, point: Point, result: Result) -> bool:
        """Add a trial. Return whether it is the best trial so far."""
        self.counts[result.status] = self.counts.get(result.status, 0) + 1
        self.done += 1
        self.simulated_s += result.simulated_s
        if self.unclear is None and result.status in ("error", "invalid", "inconclusive"):
            self.unclear = result
        low = result.robustness
        if low is None or (self.best is not None and low >= (self.best.robustness or 0.0)):
            return False
        self.best, self.best_point = result, point
        return True

    @property
    def failed(self) -> int:
        """Number of failed trials."""
        return self.counts.get("failed", 0)


@dataclass(frozen=True)
class Failure:
    """A failed trial, and the simpler case to which it was shrunk.

    Attributes:
        trial: Number of the trial.
        case: The shrunk case.
        result: Result of the shrunk case.
        runs: Number of runs that the shrinking took.

    """

    trial: int
    case: Case
    result: Result
    runs: int


class Falsifier:
    """Carries out one search, from its beginning or from the point at which it was interrupted."""

    def __init__(
        self,
        space: Space,
        search: Search,
        pool: TrialPool,
        journal: Journal,
        over: threading.Event,
        *,
        duration_s: float,
        step_s: float,
        shrink_runs: int,
    ) -> None:
        """Prepare the search.

        Args:
            space: The space, with all seeds.
            search: The search at its beginning.
            pool: Runs the trials.
            journal: Where to store the results.
            over: Ends the search when it is set.
            duration_s: Duration of a trial, in s of the instance's clock.
            step_s: Length of a step, in s.
            shrink_runs: Maximum number of runs to shrink one case.

        """
        self._space, self._search, self._pool, self._journal, self._over = space, search, pool, journal, over
        self._duration_s, self._step_s, self._shrink_runs = duration_s, step_s, shrink_runs
        self.tally = Tally()
        self.shrinking_s = 0.0
        """Time in s that it took to shrink and store cases."""
        self._points: dict[int, Point] = {}  # of trials whose results the search has not learned
        self._asked = 0
        self._limit = 0

    def _ask(self) -> Iterator[tuple[int, Point]]:
        """Yield the points that can be chosen now."""
        while self._asked < self._limit and self._asked - self.tally.done < self._pool.jobs:
            point = self._search.ask(self._asked)
            if point is None:
                self._limit = self._asked
                return
            self._points[self._asked] = point
            self._asked += 1
            yield self._asked - 1, point

    def _learn(self, result: Result) -> bool:
        """Let the search learn a result. Return whether it is the best one."""
        point = self._points.pop(result.number)
        self._search.tell(result.number, result.robustness)
        return self.tally.add(point, result)

    def replay(self, lines: Iterator[Line], trials: int) -> tuple[list[Line], list[Line]]:
        """Learn, from the journal, the results of the trials before an interruption.

        Args:
            lines: The lines of the journal (:meth:`Journal.lines`).
            trials: Number of trials of the whole search.

        Returns:
            The lines of the failed trials for which no case is stored, and the lines of the cases.

        Raises:
            ConfigError: The search does not choose the same points as before.

        """
        self._limit = max(trials, 1)
        failed: dict[int, Line] = {}
        cases: list[Line] = []
        for line in lines:
            if line.result is None:
                cases.append(line)
                failed.pop(line.trial or 0, None)
                continue
            for _ in self._ask():
                pass
            number = line.result.number
            if number != self.tally.done or dict(self._points.get(number, {})) != line.point:
                raise ConfigError(
                    f"--resume: {self._journal.file}: trial {number} has values that the search does not choose "
                    "again, perhaps because optuna has another version; begin a new search in another folder with -o"
                )
            self._learn(line.result)
            if line.result.status == "failed":
                failed[number] = line
        return list(failed.values()), cases

    def run(
        self,
        trials: int,
        on_trial: Callable[[Point, Result, bool], None],
        on_failure: Callable[[Failure], None],
        *,
        to_end: bool,
    ) -> None:
        """Run trials until the search has done ``trials`` of them, or has found a failure.

        Args:
            trials: Number of trials of the whole search.
            on_trial: Called after each trial with its point, its result, and whether it is the best
                trial so far.
            on_failure: Called with each failure, after it was shrunk.
            to_end: Whether to continue after a failure.

        Raises:
            ConfigError: None of the first trials could run, because the campaign is wrong.
            ModelError: None of the first trials could run to its end.
            RecordingError: The journal cannot be written.

        """
        self._limit = trials
        waiting = dict(self._points)  # asked before the interruption
        ready: dict[int, Result] = {}
        while self.tally.done < self._limit and not self._over.is_set():
            waiting.update(self._ask())
            for number, point in sorted(waiting.items()):
                if self._pool.idle:
                    self._pool.submit(Task(number, self._space.at(point)))
                    del waiting[number]
            ready |= {result.number: result for result in self._pool.wait(LOOK_S)}
            while (result := ready.pop(self.tally.done, None)) is not None:
                point = self._points[result.number]
                self._journal.add(Line(dict(point), result))
                on_trial(point, result, self._learn(result))
                self._check_beginning(result)
                if result.status == "failed":
                    if to_end:  # the processes are needed to shrink
                        ready |= self._drained()
                    else:
                        self._pool.cancel()
                    self.shrink(point, result, on_failure)
                    if not to_end:
                        return
                waiting.update(self._ask())

    def _drained(self) -> dict[int, Result]:
        """Wait for the trials that are running, and return their results."""
        found: dict[int, Result] = {}
        while self._pool.idle < self._pool.jobs and not self._over.is_set():
            found |= {result.number: result for result in self._pool.wait(LOOK_S)}
        return found

    def shrink(self, point: Point, result: Result, on_failure: Callable[[Failure], None]) -> None:
        """Shrink a failed trial, and call ``on_failure``, unless the user stops the search meanwhile."""
        if self._over.is_set():
            return
        begun_s = time.monotonic()
        shrinker = Shrinker(self._space, self._step_s, self._shrink_runs, self._try_out)
        case, found = shrinker.shrink(Case(dict(point), self._duration_s), result)
        if not shrinker.stopped:
            on_failure(Failure(result.number, case, found, shrinker.runs))
        self.shrinking_s += time.monotonic() - begun_s

    def _try_out(self, tables: dict[str, Any]) -> Result | None:
        self._pool.submit(Task(0, tables))
        while not self._over.is_set():
            for result in self._pool.wait(LOOK_S):
                return result
        self._pool.cancel()
        return None

    def _check_beginning(self, last: Result) -> None:
        counts, done = self.tally.counts, self.tally.done
        if done == min(FIRST_TRIALS, self._limit) and counts.get("error", 0) + counts.get("invalid", 0) == done:
            kind = ConfigError if counts.get("invalid", 0) == done else ModelError
            raise kind(f"none of the first {done} trials came to its end: {last.reason}")


def check_space(space: Space) -> None:
    """Check that a campaign has a range or a choice to search.

    Raises:
        ConfigError: The campaign has none.

    """
    if not space.dimensions:
        raise ConfigError(
            "it has no ranges to search; write a value as { from = 0, to = 5 }, or run it with shmio-campaign run"
        )
