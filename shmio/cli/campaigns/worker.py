"""``shmio-campaign worker``: runs the trials of searches on other hosts."""

from __future__ import annotations

import argparse
import asyncio
import signal
import sys

from shmio.cli.campaigns.farm import farm_of
from shmio.cli.common import say
from shmio.errors import ConfigError
from shmio.falsification.farm.worker import Worker, work_folder

MAX_JOBS = 256


def worker(arguments: argparse.Namespace) -> int:
    """Serve searches until a signal ends it.

    Raises:
        ConfigError: An option is wrong.
        MissingLibraryError: nats-py is not installed.
        RemoteError: The server refuses access.

    """
    access = farm_of(arguments)
    if arguments.jobs > MAX_JOBS:
        raise ConfigError(f"--jobs {arguments.jobs}: at most {MAX_JOBS} are possible")
    with work_folder() as folder:
        asyncio.run(_serve(Worker(access, arguments.jobs, folder, lambda line: say(line, sys.stderr))))
    return 0


async def _serve(worker: Worker) -> None:
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    heeded = [
        one
        for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if one != signal.SIGHUP or signal.getsignal(one) is not signal.SIG_IGN
    ]
    for number in heeded:
        loop.add_signal_handler(number, stop.set)
    try:
        await worker.run(stop)
    finally:
        for number in heeded:
            loop.remove_signal_handler(number)
