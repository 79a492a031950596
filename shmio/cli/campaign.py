"""``shmio-campaign``: judges the expectations of a campaign, live or over a recording.

The verbs are in ``shmio.cli.campaigns``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from shmio.cli.common import (
    add_access,
    add_json,
    add_verbs,
    at_least,
    complete,
    exit_on_signals,
    load,
    run,
    seconds,
    seed_number,
    step_ms,
    verb_first,
)
from shmio.errors import (
    ConfigError,
    LayoutError,
    MissingLibraryError,
    PathError,
    SnapshotError,
    ValueRangeError,
)
from shmio.version import __version__

PROGRAM = "shmio-campaign"
WRONG, UNDECIDED = 2, 3
FAULTS = (ConfigError, LayoutError, MissingLibraryError, PathError, SnapshotError, ValueRangeError)
"""The errors of the user's input and installation."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``shmio-campaign`` and return its exit status."""
    parser = _parser()
    complete(parser)
    arguments = parser.parse_args(verb_first(sys.argv[1:] if argv is None else argv))
    execute = load(f"shmio.cli.campaigns.{arguments.verb}:{arguments.verb}")
    with exit_on_signals():
        return run(PROGRAM, lambda: execute(arguments), arguments, _status_of)


def _status_of(error: Exception) -> int:
    """Return 2 if the user's input is wrong or a library is missing; 3 if there is no verdict for another reason."""
    return WRONG if isinstance(error, FAULTS) else UNDECIDED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Check signals against the expectations of a campaign file: in a recording, in a run, "
        "or in a search for values that fail.",
        epilog="Exit status: 0: all expectations passed; 1: one failed; 2: wrong usage or campaign; 3: inconclusive.",
    )
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    verbs = add_verbs(parser)

    def verb(name: str, text: str) -> argparse.ArgumentParser:
        return verbs.add_parser(name, help=text, description=text)

    judge = verb("judge", "judge a recording")
    judge.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recordings of one run")
    judge.add_argument("-f", dest="campaign", type=Path, required=True, metavar="CAMPAIGN.toml", help="the campaign")
    for option, what in (("--from", "begin"), ("--to", "end")):
        judge.add_argument(
            option,
            dest=what,
            metavar="TIME",
            help=f"{what} at this time: 2026-11-21T08:30:00, or seconds of the recording",
        )
    _reports(judge)
    add_json(judge)

    live = verb("run", "run a campaign on an instance or in this process, and judge it")
    live.add_argument("campaign", type=Path, metavar="CAMPAIGN.toml")
    where = live.add_mutually_exclusive_group()
    where.add_argument(
        "-c", dest="config", type=Path, metavar="FILE", help="the instance of this supervisor.toml; starts and stops it"
    )
    where.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")
    live.add_argument(
        "--lab", action="store_true", help="run in this process, without an instance; all sources must be computed"
    )
    _settings(live)
    live.add_argument(
        "--for", dest="for_s", type=seconds, metavar="S", help="duration (default: duration_s of the file)"
    )
    live.add_argument(
        "--step-ms",
        type=step_ms,
        metavar="N",
        help="length of a step (default: step_ms of the file, or the shortest period)",
    )
    live.add_argument("--real-time", action="store_true", help="run in real time, even if all sources could be stepped")
    live.add_argument(
        "--seed", type=seed_number, metavar="N", help="seed for those injections of the file that have none"
    )
    live.add_argument(
        "--start", metavar="NAME", help="restore this snapshot before the run (default: start of the file)"
    )
    live.add_argument("--stop", action="store_true", help="stop at the first failure")
    live.add_argument("--record", type=Path, metavar="FILE.mem", help="record the run to a new file")
    _reports(live)
    add_json(live)
    _falsify(verb("falsify", "search the ranges of a campaign for values at which an expectation fails"))
    _worker(verb("worker", "run the trials of searches on other hosts (falsify --farm)"))
    return parser


def _falsify(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("campaign", type=Path, metavar="CAMPAIGN.toml")
    verb.add_argument("--trials", type=at_least(1), default=200, metavar="N", help="number of trials (default: 200)")
    verb.add_argument(
        "-c",
        dest="config",
        type=Path,
        metavar="FILE",
        help="the supervisor.toml (default: the key config of the campaign)",
    )
    verb.add_argument(
        "--search",
        choices=("tpe", "cmaes", "random", "grid"),
        default="tpe",
        help="the strategy (default: tpe); tpe and cmaes need optuna",
    )
    verb.add_argument(
        "--jobs",
        type=at_least(1),
        default=1,
        metavar="N",
        help="trials at once (default: 1); with --farm, on all workers together",
    )
    verb.add_argument("--seed", type=seed_number, metavar="N", help="the same seed gives the same trials (default: 0)")
    verb.add_argument("--all", action="store_true", help="go on after the first failure")
    verb.add_argument("--resume", action="store_true", help="continue an interrupted search")
    verb.add_argument(
        "-o", dest="output", type=Path, metavar="FOLDER", help="folder of the search (default: NAME-falsify)"
    )
    _settings(verb)
    verb.add_argument("--for", dest="for_s", type=seconds, metavar="S", help="duration (default: that of the file)")
    verb.add_argument(
        "--step-ms", type=step_ms, metavar="N", help="length of a step (default: that of the file, or the period)"
    )
    verb.add_argument(
        "--limit", type=seconds, default=60, metavar="S", help="maximum real time of a trial (default: 60 s)"
    )
    verb.add_argument(
        "--shrink", type=at_least(0), default=100, metavar="N", help="runs to shrink a case (default: 100)"
    )
    verb.add_argument("--farm", metavar="URL", help="run the trials on the workers at this NATS server")
    verb.add_argument(
        "--send",
        type=Path,
        action="append",
        default=[],
        metavar="PATH",
        help="a file or folder that the models need on the workers, besides their Python files",
    )
    _access(verb)
    add_json(verb)


def _worker(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--farm", required=True, metavar="URL", help="the NATS server, such as nats://host:4222; several with commas"
    )
    verb.add_argument("--jobs", type=at_least(1), default=1, metavar="N", help="trials at once (default: 1)")
    _access(verb)


def _access(verb: argparse.ArgumentParser) -> None:
    """Add the options for the connection to a NATS server."""
    add_access(verb)
    verb.add_argument("--insecure", action="store_true", help="allow a NATS server on another host in plain text")


def _settings(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a value for a range of the campaign, such as late.start_s=3",
    )


def _reports(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with plots: one HTML file")
    verb.add_argument("--junit", type=Path, metavar="FILE.xml", help="write a report as JUnit XML, for CI servers")


if __name__ == "__main__":
    sys.exit(main())
