"""The process that evaluates the alerts."""

from __future__ import annotations

import logging
import os
import selectors
import time
from pathlib import Path
from typing import Final

import msgspec

from shmio import worker
from shmio.config import Alert, Mqtt
from shmio.endpoints.alerts.dispatcher import Dispatcher
from shmio.endpoints.alerts.monitor import Monitor
from shmio.endpoints.alerts.state_file import FILE_NAME, AlertState, State, StateWriter, digest, read_state
from shmio.layout.topic import shorten
from shmio.logs import rate_limited
from shmio.segment.doorbell import Relay
from shmio.worker import BEAT_S, Worker

MAX_NOTE: Final = 300
"""Maximum length of the note that the process shows in its status, in characters."""
WRITE_S: Final = 1.0
"""Maximum time, in s, that :meth:`Alerts.close` waits for the disk."""

log = logging.getLogger("shmio.alerts")


class Settings(msgspec.Struct):
    """The configuration that this process receives."""

    alert: list[Alert]
    mqtt: Mqtt | None
    log_dir: str


class Alerts:
    """Evaluates all alerts, and delivers their notices.

    Use it from one thread: call :meth:`run_once` repeatedly, then :meth:`close`.
    """

    def __init__(self, worker: Worker, settings: Settings) -> None:
        segment = worker.segment
        self._worker, self._alerts = worker, settings.alert
        self._epoch, self._clock, self._slot = segment.header.epoch, segment.clock, worker.slot.index
        self._selector = selectors.DefaultSelector()
        self._wakeup = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._selector.register(self._wakeup, selectors.EVENT_READ, lambda _: os.eventfd_read(self._wakeup))
        file = Path(settings.log_dir) / FILE_NAME
        before = read_state(file, self._epoch)
        self._writer = StateWriter(file)
        self._dispatcher = Dispatcher(settings.alert, settings.mqtt, segment, self._selector, self.wake, before.waiting)
        self._monitor = Monitor(segment, settings.alert, before.progress(settings.alert), self._selector)
        self._steps = Relay(segment.clock.slot_bell(self._slot), "alerts-steps")
        self._selector.register(self._steps.descriptor, selectors.EVENT_READ, lambda _: self._steps.acknowledge())
        self._clock.deliver(self._slot, 0)  # from now on, each step waits until its frames are evaluated
        self._notices = 0
        self._told_s = 0.0
        self._rest_s = 0.0
        self._waiting = 0
        self._closed = False

    def wake(self) -> None:
        """Wake :meth:`run_once`. Any thread may call it."""
        if not self._closed:  # the thread of an action may outlive close()
            os.eventfd_write(self._wakeup, 1)

    def run_once(self) -> None:
        """Wait until there is something to do, and do it."""
        for key, events in self._selector.select(self._rest_s):
            key.data(events)
        notices, more = self._monitor.run_once()
        for one, notice in notices:
            self._notices += 1
            self._dispatcher.put(one.alert, notice)
        rest_s = self._dispatcher.run_once()
        if self._monitor.changed or self._dispatcher.waiting_count != self._waiting:
            self._save()
        if (done := self._monitor.done) != self._clock.delivered(self._slot):
            self._clock.deliver(self._slot, done)
        self._rest_s = 0.0 if more else min(rest_s, self._monitor.pause_s())
        if time.monotonic() - self._told_s >= BEAT_S:
            self._told_s = time.monotonic()
            self.report()

    def report(self) -> None:
        """Write the counters and the status note of this process to the process table."""
        monitor, dispatcher = self._monitor, self._dispatcher
        active = [one.alert.title for one in monitor.alerts if one.active]
        counters = (
            len(active), self._notices, monitor.suppressed, self._waiting, dispatcher.failed, monitor.missed,
        )  # fmt: skip
        note = f"active: {', '.join(active)}" if active else ""
        problem = "; ".join(filter(None, (dispatcher.problem, self._writer.problem)))
        self._worker.report(counters, note=shorten("; ".join(filter(None, (problem, note))), MAX_NOTE))
        self._worker.report_readers(monitor.readers)

    def close(self) -> None:
        """End all actions, and save the state of the alerts."""
        self._clock.abstain(self._slot)
        self._monitor.close()
        self._dispatcher.close()
        self._save()
        self._writer.close(WRITE_S)
        if self._waiting:
            log.warning("%d notices are not delivered yet; the next process continues with them", self._waiting)
        self._selector.unregister(self._steps.descriptor)
        self._steps.join()
        self._selector.close()
        self._closed = True
        os.close(self._wakeup)

    def _save(self) -> None:
        self._monitor.changed = False
        self._waiting = self._dispatcher.waiting_count  # first: the next turn notices a later change
        alerts = {
            one.alert.title: AlertState(
                digest(one.alert), one.alert.severity, one.alert.text, one.finding.reason, one.lifecycle.progress
            )
            for one in self._monitor.alerts
        }
        self._writer.write(State(self._epoch, alerts, self._dispatcher.waiting))


def run(worker: Worker) -> None:
    """Evaluate the alerts and deliver their notices, until the worker is stopped."""
    with rate_limited(log.name):
        alerts = Alerts(worker, msgspec.convert(worker.config, Settings))
        worker.on_stop(alerts.wake)
        log.info("this process watches %d alerts", len(worker.config["alert"]))
        worker.running()
        while not worker.stopping.is_set():
            alerts.run_once()
        alerts.close()
        alerts.report()


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
