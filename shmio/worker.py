"""Base of all child processes: handles their log, heartbeat, reports, reloads and stop requests.

A worker's ``__main__`` is one line: ``raise SystemExit(worker.main(run))``, where ``run(worker)``
does the work of the process. The exit status is 0 if the worker stopped as requested, 1 if it
failed and a restart may help, and 2 if it failed and the configuration must be changed first.

A worker outlives its supervisor. The next supervisor takes it over: see
:mod:`shmio.supervisor.takeover`.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec

from shmio import garbage, logs, realtime
from shmio.audit import trail
from shmio.audit.file import AuditSettings
from shmio.errors import ConfigError, LayoutError, SegmentError, ShmioError
from shmio.segment import Activity, Block, Report, Segment

BEAT_S = 0.2
ROLE_WAIT_S = 10.0
MAX_SPEC_BYTES = 1 << 26
STDIN = 0


class Worker:
    """A child process of the instance. Threads other than the main thread may use only ``stopping``."""

    def __init__(self, spec: dict[str, Any]) -> None:
        self.name: str = spec["name"]
        self.kind: str = spec["kind"]
        self.config: dict[str, Any] = spec["config"]
        self._revision = spec.get("revision", 0)
        self.stopping = threading.Event()
        self._on_stop: Callable[[], object] | None = None
        self._on_reread: Callable[[], object] | None = None
        self._read_blocks: set[Block] = set()  # the blocks with a reader at the last call of report_readers()
        self._rereads = False  # True once SIGHUP has come, perhaps before on_reread()
        self.log = self._set_up_log(Path(spec["log_file"]), spec.get("log_format", "text"))
        self.segment = Segment.open(spec["instance"], writable=True)
        trail.open_trail(msgspec.convert(spec.get("audit"), AuditSettings | None), spec["instance"], self.name)
        if self.segment.header.epoch != spec["epoch"]:
            raise SegmentError(
                f"the segment of instance {spec['instance']!r} belongs to another run; this process ends"
            )
        self.slot = self.segment.processes.find(self.name)
        self._take_role()
        self.before = self.slot.report
        """Last report of the previous process in this role."""
        self._install_signal_handlers()
        self._report = Report(os.getpid(), Activity.STARTING, time.monotonic_ns())
        self.slot.report = self._report
        self.slot.beat()

    def _set_up_log(self, file: Path, form: str) -> logging.Logger:
        source = self.name if self.kind == "source" else None
        # A full disk must not stop the work: the log is retried at each record.
        return logs.setup(file, self.name, source=source, form=form, streams=True, patient=True)

    def _take_role(self) -> None:
        """Wait until the previous process in this role has ended, and take its lock."""
        deadline = time.monotonic() + ROLE_WAIT_S
        while not self.slot.take():
            if time.monotonic() > deadline:
                raise SegmentError(
                    f"the role {self.name} is still taken by another process, pid {self.slot.report.pid}"
                )
            time.sleep(0.02)
        # Meanwhile the supervisor may have died, and a new one may have removed the segment.
        if not self.segment.shared.current():
            raise SegmentError(f"the segment of instance {self.segment.instance!r} was removed; this process ends")

    def running(self) -> None:
        """Report to the supervisor that this process has started and is running."""
        garbage.resume()
        self.report(activity=Activity.RUNNING)
        self.log.info("the process is running")

    def report(
        self,
        counters: tuple[int, ...] | None = None,
        note: str | None = None,
        activity: Activity | None = None,
    ) -> None:
        """Send a heartbeat, and update the process table: values that are None stay unchanged.

        Also write the last log lines that a rate limit has left out.
        """
        old = self._report
        self._report = Report(
            old.pid,
            old.activity if activity is None else activity,
            old.started_ns,
            old.counters if counters is None else counters,
            old.note if note is None else note,
        )
        if self._report != old:
            self.slot.report = self._report
        self.slot.beat()
        logs.write_left_out()

    def report_readers(self, readers: Iterable[tuple[Block, int]]) -> None:
        """Report how far this process is behind with reading frames.

        Args:
            readers: For each reader, its block and the number of the last frame that it has read.
                Only the slowest reader of each block is reported.

        """
        slowest: dict[Block, int] = {}
        for block, last in readers:
            slowest[block] = min(last, slowest.get(block, last))
        for block in self._read_blocks - slowest.keys():
            block.report_reader(self.slot, None)
        for block, last in slowest.items():
            block.report_reader(self.slot, last)
        self._read_blocks = set(slowest)

    def on_stop(self, call: Callable[[], object]) -> None:
        """Call ``call`` in another thread when a stop is requested.

        If a stop has already been requested, call ``call`` now, in this thread.
        """
        self._on_stop = call
        if self.stopping.is_set():
            call()

    def on_reread(self, call: Callable[[], object]) -> None:
        """Call ``call`` in another thread at each SIGHUP, which asks a process to reread its files.

        If a SIGHUP has come since the process started, also call ``call`` now, in this thread.
        """
        self._on_reread = call
        if self._rereads:
            call()

    def revised(self) -> dict[str, Any] | None:
        """Return the configuration in a new process description from the supervisor.

        Return None if no new description has come since the start, or since the last call that
        returned a configuration. The supervisor writes a new description to the file that is this
        process's standard input, and then sends SIGHUP.
        """
        try:
            spec = json.loads(os.pread(STDIN, MAX_SPEC_BYTES, 0))
            revision, config = spec["revision"], spec["config"]
        except (OSError, ValueError, KeyError, TypeError):  # stdin is a pipe, or the supervisor is writing to it
            return None
        if revision == self._revision or not isinstance(config, dict):
            return None
        self._revision = revision
        return config

    def _install_signal_handlers(self) -> None:
        """Make SIGTERM set ``stopping``, and SIGHUP call what :meth:`on_reread` was given.

        Ignore Ctrl-C. A thread handles the signals. A signal handler would run in the main thread,
        and block for ever if that thread has locked the event.
        """
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        signal.signal(signal.SIGTERM, lambda *_: None)
        signal.signal(signal.SIGHUP, lambda *_: None)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading.Thread(target=self._await_signal, args=(reader,), name="signals", daemon=True).start()

    def _await_signal(self, reader: int) -> None:
        while os.read(reader, 1)[0] != signal.SIGTERM:
            self._rereads = True  # set first, so that a concurrent on_reread() sees it
            if self._on_reread is not None:
                self._on_reread()
        self.stopping.set()
        if self._on_stop is not None:
            self._on_stop()


class Reload:
    """A reload as a worker takes part in it, after the worker has read its new configuration.

    Create the object before you stop any work, so that it notices if the supervisor ends meanwhile.
    """

    def __init__(self, worker: Worker, woken: threading.Event) -> None:
        """Begin to wait for the supervisor.

        Args:
            worker: This process.
            woken: An event that is set at each SIGHUP, and perhaps at a stop.

        """
        self._worker, self._woken = worker, woken
        self._digest, self._supervisor = worker.slot.digest, worker.segment.supervisor[0]

    def permitted(self, begun: Callable[[], bool] = lambda: False) -> bool:
        """Wait until the supervisor permits the change.

        Args:
            begun: Returns whether the supervisor has already changed this process's part of the
                segment, which is a permission as well.

        Returns:
            Whether to change. False if the supervisor has ended before it has permitted the change,
            or if this process must stop.

        """
        worker = self._worker
        worker.report(activity=Activity.PAUSED)
        while worker.slot.digest == self._digest and not begun():
            if worker.stopping.is_set():
                return False
            if not worker.segment.supervised or worker.segment.supervisor[0] != self._supervisor:
                worker.log.warning("the supervisor ended during a reload; the %s continues as before", worker.kind)
                return False
            self._woken.wait(BEAT_S)
            self._woken.clear()
            worker.report()
        return not worker.stopping.is_set()


def main(run: Callable[[Worker], None]) -> int:
    """Run a worker until it ends, and return the exit status of the process."""
    worker = None
    garbage.pause()  # until Worker.running()
    try:
        worker = Worker(_read_spec())
        if priority := worker.config.get("realtime_priority"):
            realtime.prioritise(priority)
        run(worker)
        worker.report(activity=Activity.STOPPING)
        worker.log.info("the process has stopped")
    except ShmioError as error:
        _report_failure(worker, str(error))
        return 2 if isinstance(error, (ConfigError, LayoutError)) else 1
    except Exception:
        logging.getLogger("shmio").exception("the process failed")
        raise
    finally:
        garbage.resume()
        trail.close_trail()
    return 0


def _report_failure(worker: Worker | None, message: str) -> None:
    """Write the reason to the log and the process table."""
    if worker is None:
        sys.stderr.write(message + "\n")
    else:
        worker.log.error(message)
        worker.report(note=message)


def _read_spec() -> dict[str, Any]:
    if sys.stdin.isatty():
        raise ConfigError("this module is a worker process: only shmio-supervisor can start it")
    try:
        data = sys.stdin.buffer.read(MAX_SPEC_BYTES + 1)  # stdin stays open for a new description
        if len(data) > MAX_SPEC_BYTES:
            raise ConfigError(f"the process description is larger than {MAX_SPEC_BYTES} bytes: the layout is too large")
        spec = json.loads(data)
    except ValueError:
        raise ConfigError(
            "no process description on standard input: only shmio-supervisor can start a worker"
        ) from None
    missing = {"instance", "epoch", "name", "kind", "log_file", "config"} - set(spec)
    if missing:
        raise ConfigError(f"the process description does not have {', '.join(sorted(missing))}")
    return dict(spec)
