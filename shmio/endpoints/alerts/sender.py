"""Delivers notices in order. Each action has its own thread, so that no action has to wait for another."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Final, Protocol

from shmio.backoff import Backoff
from shmio.endpoints.alerts.notice import Notice
from shmio.errors import EndpointError

MAX_WAITING: Final = 100
"""Maximum number of notices that wait for one action. If one more comes, the oldest is dropped."""
RETRY: Final = Backoff(1.0, 60.0, jitter=0.2)
"""Waiting times between attempts to deliver a notice."""
GIVE_UP_S: Final = 3600.0
"""Time in s after which a notice that cannot be delivered is dropped."""

log = logging.getLogger("shmio.alerts")


class DeliveryError(EndpointError):
    """A notice could not be delivered. ``again`` is True if a later attempt may succeed."""

    def __init__(self, message: str, *, again: bool = False) -> None:
        super().__init__(message)
        self.again = again


class Action(Protocol):
    """A way to deliver the notices of an alert, such as a command or a webhook."""

    text: str
    """Description of the action, for messages. It contains no secrets."""

    once: bool
    """True if no notice may be delivered twice, even if it is not known whether the first attempt has succeeded."""

    def deliver(self, notice: Notice) -> None:
        """Deliver a notice, or fail, within a limited time.

        Raises:
            DeliveryError: The notice could not be delivered.

        """

    def stop(self) -> None:
        """Make a running :meth:`deliver` return soon. Any thread may call this."""


class Sender:
    """Delivers the notices of one action in order. Any thread may use it."""

    def __init__(
        self, alert: str, action: Action, on_change: Callable[[], object], waiting: Sequence[Notice] = (), *,
        turns: AbstractContextManager[object] | None = None, retry: Backoff = RETRY, give_up_s: float = GIVE_UP_S,
    ) -> None:  # fmt: skip
        """Create the sender. Its thread starts with the first notice.

        Args:
            alert: Name of the alert.
            action: The action.
            on_change: Called, from any thread, when :attr:`waiting` or :attr:`problem` has changed.
            waiting: Notices that an earlier process could not deliver.
            turns: Context manager that each attempt enters, to limit simultaneous attempts; None
                for no limit.
            retry: The waiting times between attempts.
            give_up_s: Time in s for which to retry.

        """
        self.problem = ""
        """Why the last notice could not be delivered; empty if it could."""
        self.failed = 0
        """Number of notices that were dropped."""
        self._alert, self._action, self._on_change = alert, action, on_change
        self._turns, self._retry, self._give_up_s = turns or nullcontext(), retry, give_up_s
        self._condition = threading.Condition()
        self._waiting = deque(waiting, MAX_WAITING)
        self._stopping = False
        self._thread: threading.Thread | None = None
        if waiting:
            self._start()

    @property
    def waiting(self) -> list[Notice]:
        """The notices that have not been delivered yet, the oldest first."""
        with self._condition:
            return list(self._waiting)

    @property
    def waiting_count(self) -> int:
        """Number of notices in :attr:`waiting`."""
        return len(self._waiting)

    def put(self, notice: Notice) -> None:
        """Queue a notice, without blocking. If too many are queued, drop the oldest."""
        with self._condition:
            if len(self._waiting) == MAX_WAITING:
                self._drop(f"more than {MAX_WAITING} notices wait; the oldest are dropped")
            self._waiting.append(notice)
            self._start()
            self._condition.notify()

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"alert {self._alert}", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Request the thread to end. Undelivered notices stay in :attr:`waiting`."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        self._action.stop()

    def join(self, timeout_s: float) -> None:
        """Wait at most ``timeout_s`` until the thread has ended."""
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        attempts, begun_s = 0, time.monotonic()
        while self._await():
            with self._turns:
                if (notice := self._begin()) is None:
                    return
                begun_s = begun_s if attempts else time.monotonic()
                problem = self._attempt(notice)
            if problem is None:
                attempts = 0
                self._succeed(notice)
                continue
            if self._stopping and problem.again:
                return
            again = problem.again and time.monotonic() < begun_s + self._give_up_s
            self._fail(notice, str(problem), again=again)
            attempts = attempts + 1 if again else 0
            if again:
                self._rest(self._retry.wait_s(attempts - 1))

    def _await(self) -> bool:
        """Wait for a notice. Return False if the thread must end."""
        with self._condition:
            self._condition.wait_for(lambda: self._waiting or self._stopping)
            return not self._stopping

    def _begin(self) -> Notice | None:
        """Return the next notice, or None if the thread must end."""
        with self._condition:
            if self._stopping:
                return None
            notice = self._waiting[0]
            if self._action.once:
                self._waiting.popleft()
        if self._action.once:
            self._on_change()
        return notice

    def _attempt(self, notice: Notice) -> DeliveryError | None:
        try:
            self._action.deliver(notice)
        except DeliveryError as error:
            return error
        return None

    def _rest(self, wait_s: float) -> None:
        with self._condition:
            self._condition.wait_for(lambda: self._stopping, wait_s)

    def _succeed(self, notice: Notice) -> None:
        with self._condition:
            self._remove(notice)
            if self.problem:
                log.info("alert %s: %s works again", self._alert, self._action.text)
            self.problem = ""
        log.info("alert %s: its notice (%s) was delivered by %s", self._alert, notice.state, self._action.text)
        self._on_change()

    def _fail(self, notice: Notice, problem: str, *, again: bool) -> None:
        text = f"alert {self._alert}: {self._action.text}: {problem}"
        with self._condition:
            if not again:
                self._remove(notice)
                self.failed += 1
                log.error("%s; this notice (%s) is lost", text, notice.state)
            elif text != self.problem:
                log.warning("%s; shmio tries again", text)
            self.problem = text
        self._on_change()

    def _remove(self, notice: Notice) -> None:
        if self._waiting and self._waiting[0] is notice:  # else put() has dropped the notice meanwhile
            self._waiting.popleft()

    def _drop(self, problem: str) -> None:
        self._waiting.popleft()
        self.failed += 1
        self.problem = f"alert {self._alert}: {self._action.text}: {problem}"
        if self.failed % MAX_WAITING == 1:
            log.error("%s", self.problem)
