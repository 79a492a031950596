"""``shmio-campaign``: judges what a campaign expects, live or over a recording.

The verbs are in ``shmio.cli.campaigns``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from shmio.cli.run import add_json, complete, exit_on_signals, load, run
from shmio.errors import ConfigError, LayoutError, PathError, ValueRangeError
from shmio.version import __version__

PROGRAM = "shmio-campaign"
WRONG, UNDECIDED = 2, 3


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``shmio-campaign`` and return its exit status."""
    parser = _parser()
    complete(parser)
    arguments = parser.parse_args(argv)
    execute = load(f"shmio.cli.campaigns.{arguments.verb}:{arguments.verb}")
    with exit_on_signals():
        return run(PROGRAM, lambda: execute(arguments), arguments, _status_of)


def _status_of(error: Exception) -> int:
    """Return 2 if the campaign or the configuration is wrong; 3 if there is no verdict for another reason."""
    return WRONG if isinstance(error, ConfigError | LayoutError | PathError | ValueRangeError) else UNDECIDED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Judge what a campaign file expects of signals.",
        epilog="Exit status: 0 all expectations passed, 1 one failed, 2 wrong usage or campaign, 3 inconclusive.",
    )
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, text: str) -> argparse.ArgumentParser:
        return verbs.add_parser(name, help=text, description=text)

    judge = verb("judge", "judge a recording")
    judge.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recordings of one run")
    judge.add_argument("-f", dest="campaign", type=Path, required=True, metavar="CAMPAIGN.toml", help="the campaign")
    for option, what in (("--from", "begin"), ("--to", "end")):
        judge.add_argument(
            option, dest=what, metavar="TIME", help=f"{what} there: 2026-11-21T08:30:00, or seconds of the recording"
        )
    add_json(judge)
    return parser


if __name__ == "__main__":
    sys.exit(main())
