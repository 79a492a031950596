"""``shmio-supervisor up``: starts an instance in this process, which becomes its supervisor."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec

from shmio import garbage, logs
from shmio.cli.common import say
from shmio.cli.instance.detach import Configured, Failed, Started, StartMessage, headline, replay_keys
from shmio.cli.target import config_file
from shmio.config import Address
from shmio.errors import ConfigError, LayoutError, ShmioError
from shmio.libraries import skip_package_code
from shmio.plan.prepare import Prepared, peer, prepare
from shmio.plan.processes import BROKER, Job, Plan
from shmio.segment import State, instances
from shmio.supervisor.main import Supervisor
from shmio.supervisor.start import check_startable, hold_log_folder
from shmio.wording import counted, printable


def up(arguments: argparse.Namespace) -> int:
    """Start an instance, and return once it has stopped.

    With ``--report``, act as the child process of ``up --detach``.
    """
    file, mode, keys = config_file(arguments), arguments.mode, replay_keys(arguments)
    garbage.pause()  # until the instance runs
    if arguments.report is not None:
        return _detached(file, mode, keys, arguments.report)
    return _foreground(file, mode, keys)


def _foreground(file: Path, mode: str, keys: Mapping[str, Any]) -> int:
    """Run an instance in a terminal; ``keys`` are keys of ``[replay]`` from the command line."""
    prepared = prepare(file, mode, keys)
    plan = prepared.plan
    for warning in plan.warnings:
        say(warning, sys.stderr)
    check_startable(plan)
    left_over = plan.instance in instances()
    say(headline(plan.instance, plan.mode, None if left_over else plan.segment_bytes, plan.log_dir))
    for line in _processes(prepared):
        say(line)
    say("Ctrl-C stops it, and so does closing the terminal")
    console = logging.StreamHandler(sys.stderr)
    console.setFormatter(_Console())
    hints = list(_hints(prepared))

    def on_state(state: State) -> None:
        garbage.resume()
        if state in (State.RUNNING, State.DEGRADED):  # not before: nobody would answer
            while hints:
                say(hints.pop(0))

    with hold_log_folder(plan.log_dir, plan.instance):
        logs.setup(_log_file(plan), "supervisor", form=plan.log_format)
        logging.getLogger("shmio.supervisor").addHandler(console)
        Supervisor(plan, replan=_replan(plan, keys), on_state=on_state).run()
    return 0


def _detached(file: Path, mode: str, keys: Mapping[str, Any], report: int) -> int:
    """Run an instance without a terminal.

    Send the result of the start to the descriptor ``report``.
    """
    finished = False

    def send(message: StartMessage) -> None:
        nonlocal finished
        if finished:
            return
        finished = not isinstance(message, Configured)
        with suppress(OSError):  # the waiting process has given up
            os.write(report, msgspec.json.encode(message) + b"\n")
        if finished:
            os.close(report)

    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        skip_package_code("snap7")  # as in shmio.emulators
        prepared = prepare(file, mode, keys)
        plan = prepared.plan
        send(Configured(printable(str(_log_file(plan))), tuple(map(printable, plan.warnings))))
        check_startable(plan)

        def on_state(state: State) -> None:
            garbage.resume()
            if state is not State.STOPPING:
                history, processes = (
                    [*map(printable, lines)]
                    for lines in (supervisor.history, chain(_processes(prepared), _hints(prepared)))
                )
                send(Started(plan.instance, history, processes))

        with hold_log_folder(plan.log_dir, plan.instance):
            logs.setup(_log_file(plan), "supervisor", form=plan.log_format, streams=True)
            with _log_file(plan).open("ab") as log:
                for stream in (sys.stdout, sys.stderr):
                    os.dup2(log.fileno(), stream.fileno())
            supervisor = Supervisor(plan, replan=_replan(plan, keys), on_state=on_state)
            supervisor.run()
    except ShmioError as error:
        faulty = isinstance(error, ConfigError | LayoutError)
        send(Failed("\n".join(map(printable, str(error).split("\n"))), faulty))
        return 1
    except OSError as error:
        send(Failed(printable(f"{error.filename}: {error.strerror}" if error.filename else str(error))))
        return 1
    send(Failed("it was stopped while it started"))
    return 0


def _log_file(plan: Plan) -> Path:
    return plan.log_dir / "supervisor.log"


def _replan(plan: Plan, keys: Mapping[str, Any]) -> Callable[[], Plan]:
    """Return a function that makes a new plan from the same file, for reloads."""
    return lambda: prepare(plan.config_file, plan.mode, keys).plan


def _processes(prepared: Prepared) -> Iterator[str]:
    """Yield a line about each process of the plan."""
    jobs = prepared.plan.jobs
    width = max((len(job.name) for job in jobs), default=0)
    for job in sorted(jobs, key=lambda job: job.rank):
        yield f"  {job.name:<{width}}  {job.kind:<8}  {_describe(job, prepared)}"
    yield from prepared.notes


def _hints(prepared: Prepared) -> Iterator[str]:
    """Yield what the user can do now that the instance runs."""
    for job in prepared.plan.jobs:
        if job.name == "web" and not Address.parse(job.config["listen"]).wildcard:
            yield f"open {_describe(job, prepared)} in a browser to see the cell"


def _describe(job: Job, prepared: Prepared) -> str:
    config = job.config
    if job.kind == "source":
        layout = prepared.layouts[job.name]
        source = next(source for source in prepared.config.source if source.name == job.name)
        device = f"{source.connector} {peer(source)}".rstrip()
        return f"{device}, {layout.name}: {layout.size} bytes every {source.period_ms:g} ms"
    if job.kind == "emulator":
        return f"{config['kind']} on {config['listen']}, program {config['program']}"
    if job.kind == "recorder":
        return f"to {config['directory']}"
    if job.kind == "mqtt":
        return f"{config['broker']} on {config['listen']}" if job.name == BROKER else f"under {config['prefix']}/"
    if job.kind == "fabric":
        return f"cell {config['cell']} at {', '.join(config['access']['servers'])}" if "access" in config else _at(job)
    if job.kind == "web":
        scheme = "https" if config["certificate"] else "http"
        return f"{scheme}://{config['listen']}/{'' if job.name == 'web' else 'metrics'}"
    if job.kind == "alerts":
        return f"watching {counted(len(config['alert']), 'alert')}"
    return _at(job)


def _at(job: Job) -> str:
    return f"on {', '.join(job.listening)}"


class _Console(logging.Formatter):
    """Formats a log record as its message alone."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(record.getMessage())
