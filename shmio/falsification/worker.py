"""A process that runs trials, one after another: it reads each trial as a line of JSON, and writes its result.

The process first writes an empty line when it is ready. A model that crashes or hangs affects only
this process.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import msgspec

from shmio.falsification.trial import Task, run_trial
from shmio.lab import prepare_laboratory
from shmio.parent import end_with_parent


def main() -> None:
    """Run the parent's trials until the parent closes standard input.

    The arguments of the process are the parent's pid, the configuration file, and the folder of the
    campaign.
    """
    if not end_with_parent(int(sys.argv[1])):
        return
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # they reach the parent, too, which decides
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what models print must not get into the answers
    instance, folder = prepare_laboratory(Path(sys.argv[2])), Path(sys.argv[3])
    answers.write(b"\n")  # it is ready
    answers.flush()
    for line in sys.stdin.buffer:
        result = run_trial(instance, folder, msgspec.json.decode(line, type=Task))
        answers.write(msgspec.json.encode(result) + b"\n")
        answers.flush()


if __name__ == "__main__":
    main()
