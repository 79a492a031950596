"""Runs one trial in a laboratory: a campaign without ranges."""

from __future__ import annotations

import time
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any, Final, Literal

import msgspec

from shmio.campaigns.live import Plan
from shmio.config.campaign import campaign_of
from shmio.errors import ConfigError, DeclarationError, LayoutError, ShmioError
from shmio.judging.verdict import Outcome, Verdict
from shmio.lab import Laboratory
from shmio.plan.processes import Plan as InstancePlan
from shmio.simulation.model import explain

LIMIT: Final = 1e300
"""Maximum of the robustness; greater values count as this value, because an optimiser takes no infinity."""

Status = Literal["passed", "failed", "inconclusive", "error", "invalid"]


class Task(msgspec.Struct):
    """A trial to run.

    Attributes:
        number: Number of the trial.
        tables: The tables of the campaign, without ranges and with all seeds.

    """

    number: int
    tables: dict[str, Any]


class Found(msgspec.Struct):
    """The verdict on an expectation.

    Attributes:
        name: Name of the expectation.
        outcome: The outcome.
        robustness: Upper bound of the robustness; None if there is no bound.
        reason: Why the expectation did not pass; empty if it passed.
        moment_s: First moment at which the expectation was not met, on the instance's clock in s.

    """

    name: str
    outcome: Outcome
    robustness: float | None
    reason: str = ""
    moment_s: float | None = None


class Result(msgspec.Struct):
    """The result of a trial.

    Attributes:
        number: Number of the trial.
        status: ``failed`` if an expectation failed; otherwise ``error`` if the run did not come to
            its end, ``invalid`` if the campaign is not valid with these values, ``inconclusive`` if
            an expectation is inconclusive, and ``passed`` if all expectations passed.
        expectations: The verdicts; empty if there was no run.
        reason: Why there was no run, or why it ended early; empty otherwise.
        begin_s: Start of the run on the instance's clock, in s; not 0 if it started from a snapshot.
        simulated_s: Simulated time of the run, in s.
        taken_s: Real time that the trial took, in s.

    """

    number: int
    status: Status
    expectations: list[Found] = []
    reason: str = ""
    begin_s: float = 0.0
    simulated_s: float = 0.0
    taken_s: float = 0.0

    @property
    def robustness(self) -> float | None:
        """The least robustness of all expectations, which the search minimises; below 0 if one has failed.

        The robustness of an expectation is the greatest that is possible for any values in place of
        unknown ones, so that of an inconclusive expectation is never below 0. None if there is
        nothing to minimise.
        """
        if self.status in ("error", "invalid"):
            return None
        known = [one.robustness for one in self.expectations if one.robustness is not None]
        return min(known, default=None)

    @property
    def worst(self) -> Found | None:
        """The verdict on the expectation with the least robustness; None if no expectation has any."""
        known = [one for one in self.expectations if one.robustness is not None]
        return min(known, key=lambda one: one.robustness or 0.0, default=None)

    @property
    def failed(self) -> list[str]:
        """Names of the expectations that failed."""
        return [one.name for one in self.expectations if one.outcome is Outcome.FAILED]


def run_trial(instance: InstancePlan, folder: Path, task: Task) -> Result:
    """Run a trial in this process.

    Args:
        instance: The plan of the instance.
        folder: Folder of the campaign file.
        task: The trial.

    Returns:
        The result, which also describes errors; no error is raised.

    """
    begun_s = time.monotonic()
    expectations: list[Found] = []
    begin_s, simulated_s, reason = 0.0, 0.0, ""
    status: Status
    try:
        campaign = campaign_of(task.tables)
        step_s = None if campaign.step_ms is None else campaign.step_ms / 1000
        plan = Plan(
            campaign.injection, campaign.expect, campaign.duration_s or 0.0, folder, step_s, start=campaign.start
        )
        with Laboratory(instance, campaign.parameters) as lab:
            work = lab.run(plan)
            begin_s = 0.0 if work.start is None else work.start.time_ns / 1e9
            simulated_s = lab.page.present_ns() / 1e9 - begin_s
        expectations = [_found(verdict) for verdict in work.judge.verdicts]
        status = _status(expectations, problem=work.problem)
        reason = "" if work.problem is None else str(work.problem)
    except (ConfigError, DeclarationError, LayoutError) as error:
        status, reason = "invalid", str(error)
    except ShmioError as error:
        status, reason = "error", str(error)
    except Exception as error:  # noqa: BLE001  a model can raise anything
        status, reason = "error", explain(error, "")
    taken_s = time.monotonic() - begun_s
    return Result(task.number, status, expectations, reason, begin_s, simulated_s, taken_s)


def _found(verdict: Verdict) -> Found:
    high = verdict.high
    robustness = None if high == float("inf") else max(-LIMIT, min(high, LIMIT)) if isfinite(high) else -LIMIT
    moment_s = None if verdict.moment_ns is None else verdict.moment_ns / 1e9
    return Found(verdict.expectation.name, verdict.outcome, robustness, verdict.reason, moment_s)


def _status(expectations: Sequence[Found], problem: ShmioError | None) -> Status:
    outcomes = {one.outcome for one in expectations}
    if Outcome.FAILED in outcomes:
        return "failed"
    if problem is not None:
        return "error"
    return "inconclusive" if Outcome.INCONCLUSIVE in outcomes else "passed"
