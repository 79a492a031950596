"""Polls of DB201 a second over a link of 1 ms, where 1,000 are due, with one or more reads in progress at a time.

The source's own loop polls into a segment, as in an instance. A read has five jobs, because the controller grants a
PDU of 480 bytes. Controller, link and source are separate processes.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from contextlib import ExitStack
from functools import partial

from common import Child, begin, db201, interleave, table

from shmio.config.address import Address
from shmio.connectors.poll_loop import Schedule, SourceLoop, WallClock
from shmio.connectors.s7.connector import S7Connector, S7Options
from shmio.segment import BlockSpec, ProcessSpec, Segment

PERIOD_NS = 1_000_000
JOBS = (5, 10, 20)  # granted and used; 5 are one read


class Source:
    """A source's loop in a thread of this process."""

    def __init__(self, segment: Segment, name: str, address: Address, jobs: int) -> None:
        options = S7Options(host=address.host, port=address.port, maxJobs=jobs)
        self._connector = S7Connector(options, db201())
        self._segment = segment
        self._name = name

    def polls_and_overruns(self, duration_s: float) -> tuple[float, float]:
        """Run for a while. Return polls and overruns a second, without the first 0.2 s."""
        clock = WallClock()
        block = self._segment.blocks[self._name]
        schedule = Schedule(self._segment.header.started_ns, block.period_ns)
        loop = SourceLoop(self._connector, self._segment.writer(self._name), schedule, clock)
        thread = threading.Thread(target=loop.run)
        thread.start()
        time.sleep(0.2)
        before = loop.counters.polls, loop.counters.overruns
        time.sleep(duration_s)
        after = loop.counters.polls, loop.counters.overruns
        clock.stop()
        thread.join()
        return (after[0] - before[0]) / duration_s, (after[1] - before[1]) / duration_s


def main() -> None:
    quick = begin("S7: polls of DB201 at 1 kHz, PDU 480, 1 ms round trip added")
    logging.getLogger("shmio").addHandler(logging.NullHandler())  # each round ends with a bad frame, as it should
    rounds, round_s = (2, 0.3) if quick else (5, 4.0)
    with ExitStack() as stack:
        plc = stack.enter_context(Child("plc.py", "--pdu", 480, "--jobs", max(JOBS)))
        address = Address.parse(stack.enter_context(Child("link.py", plc.hello, 1)).hello)
        names = {jobs: f"jobs{jobs}" for jobs in JOBS}
        blocks = [BlockSpec(name, db201(), PERIOD_NS, 10**9, 1 << 24) for name in names.values()]
        processes = [ProcessSpec(name, "source") for name in names.values()]
        segment = stack.enter_context(Segment.create(f"bench-{os.getpid()}", blocks, processes))
        stack.callback(segment.unlink)
        overruns: dict[int, list[float]] = {jobs: [] for jobs in JOBS}

        def sample(jobs: int) -> float:
            polls, over = Source(segment, names[jobs], address, jobs).polls_and_overruns(round_s)
            overruns[jobs].append(over)
            return polls

        polls = interleave({names[jobs]: partial(sample, jobs) for jobs in JOBS}, rounds)
        rows = []
        for jobs in JOBS:
            seen = sorted(polls[names[jobs]])
            rows.append(
                [
                    f"{jobs} jobs: {jobs // JOBS[0]} under way",
                    *(f"{value:.0f}" for value in (seen[0], seen[len(seen) // 2], seen[-1])),
                    f"{sorted(overruns[jobs])[len(seen) // 2]:.0f}",
                ]
            )
    table(["polls/s", "least", "median", "most", "overruns/s, median"], rows)


if __name__ == "__main__":
    main()
