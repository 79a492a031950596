"""Reloads: planned in a thread, so that the supervisor goes on looking after what runs, and carried out by its loop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from shmio.errors import ShmioError
from shmio.logs import fields
from shmio.segment import Segment
from shmio.supervisor.change import Change
from shmio.supervisor.control import Answer
from shmio.supervisor.fleet import Fleet
from shmio.supervisor.managed import brief, log
from shmio.supervisor.notify import Notifier
from shmio.supervisor.plan import Plan
from shmio.supervisor.policy import Limits
from shmio.supervisor.reconcile import refusal


class _Planning:
    """A plan in the making: to compile a big layout takes seconds, and a file system may hang."""

    def __init__(self, replan: Callable[[], Plan], limit_s: float) -> None:
        self.read_ns = time.time_ns()
        self.limit_s = limit_s
        self._deadline = time.monotonic() + limit_s
        self._plan: Plan | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(replan,), name="plan", daemon=True)
        self._thread.start()

    def _run(self, replan: Callable[[], Plan]) -> None:
        try:
            self._plan = replan()
        except BaseException as error:  # noqa: BLE001 - raised by ``result``
            self._error = error

    @property
    def over(self) -> bool:
        return not self._thread.is_alive()

    @property
    def late(self) -> bool:
        """Whether it has had its time. A thread cannot be ended: its result, if there ever is one, is lost."""
        return not self.over and time.monotonic() >= self._deadline

    def result(self) -> Plan:
        """The plan, or what went wrong."""
        if not self.over:
            raise ShmioError(
                f"what the configuration names could not be read within {self.limit_s:g} s, and nothing is changed: "
                "see whether a file system hangs, and reload again"
            )
        if self._plan is None:
            raise self._error or RuntimeError("there is no plan")
        return self._plan


class Changer:
    """The change of an instance that is under way, if any, and the plan that it follows by now."""

    def __init__(
        self,
        fleet: Fleet,
        segment: Segment,
        notifier: Notifier,
        plan: Plan,
        replan: Callable[[], Plan],
        limits: Limits,
    ) -> None:
        self.plan = plan
        self.read_ns = time.time_ns()
        """When the configuration was read, ns since 1970."""
        self._fleet = fleet
        self._segment = segment
        self._notifier = notifier
        self._replan = replan
        self._limits = limits
        self._planning: _Planning | None = None
        self._change: Change | None = None
        self._answer: Answer | None = None

    @property
    def under_way(self) -> bool:
        """Whether processes and blocks are being changed."""
        return self._change is not None

    def busy(self) -> str | None:
        """Why nothing else can be changed at present."""
        if self._change is None:
            return None
        if stuck := self._change.stuck:
            return f"the instance is just being changed, which waits for what does not end: {stuck}"
        return "the instance is just being changed: ask again when that is over"

    def follow(self) -> None:
        """Bring what was taken over to the plan. SegmentError: no room."""
        self._change = Change(self._fleet, self._segment, self.plan)

    def reload(self, answer: Answer) -> None:
        """Plan anew, then follow that; refused while another reload is under way."""
        reason = self.busy() or (self._planning and "another reload is just being planned: ask again when it is over")
        if reason:
            answer.error(reason)
            return
        self._notifier.reloading()
        self._planning, self._answer = _Planning(self._replan, self._limits.plan_s), answer

    def drop(self) -> None:
        """Give up what is under way, for all is to stop."""
        if self._answer is not None:
            self._answer.error("the instance is stopping")
        self._planning = self._change = self._answer = None

    def step(self) -> None:
        """Do what can be done now."""
        if self._planning is not None and (self._planning.over or self._planning.late):
            planning, self._planning = self._planning, None
            self._begin(planning)
        if self._change is not None:
            self._follow(self._change)

    def _begin(self, planning: _Planning) -> None:
        try:
            plan = planning.result()
            if reason := refusal(plan, self.plan):
                raise ShmioError(f"{plan.config_file}: {reason}")
            self._change = Change(self._fleet, self._segment, plan)
        except Exception as error:  # noqa: BLE001 - whatever a connector's own check raises, what runs goes on
            expected = isinstance(error, ShmioError)
            reason = str(error) if expected else f"the reload failed: {brief(error)}"
            log.error("nothing is changed: %s", reason, exc_info=None if expected else error)
            self._tell(lambda answer: answer.error(reason))
            return
        self.plan, self.read_ns = plan, planning.read_ns

    def _follow(self, change: Change) -> None:
        if not change.step():
            if stuck := change.stuck:
                self._tell(lambda answer: answer.error(f"{stuck}; the reload goes on as soon as it has ended"))
            return
        done, problems = change.outcome()
        for line in done:
            log.info("%s", line)
        for line in problems:
            log.error("%s", line)
        kept = list(change.changes.kept)
        log.info("the change is over", extra=fields(kept=len(kept)))
        self._change = None
        told = {"warnings": list(change.plan.warnings), "done": done, "problems": problems, "kept": kept}
        self._tell(lambda answer: answer.ok(**told))

    def _tell(self, how: Callable[[Answer], None]) -> None:
        """Answer who has asked, if nobody has yet."""
        if self._answer is not None:
            self._notifier.ready()
            how(self._answer)
            self._answer = None
