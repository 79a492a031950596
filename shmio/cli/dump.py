"""``shmio-dump``: records a running instance, and examines recordings.

The verbs are in ``shmio.cli.recordings``.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from shmio.cli.common import add_access, add_full, add_json, complete, exit_on_signals, load, run
from shmio.version import __version__
from shmio.wording import unknown

PROGRAM = "shmio-dump"
MODULES = {"info": "examine", "verify": "examine", "cut": "rewrite", "merge": "rewrite", "recover": "rewrite"}
"""The module of each verb whose module has a different name."""
SOME_FILES = "print JSON: one object, or a list for several files"
IGNORABLE = ("times", "cycle", "reason", "events", "ends")
"""Valid values of ``diff --ignore``.

They are a copy of those in shmio.recording.compare, so that this module need not import it.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``shmio-dump`` and return its exit status."""
    parser = _parser()
    complete(parser)
    arguments, rest = parser.parse_known_args(argv)
    if rest and (arguments.verb != "cat" or any(word.startswith("-") for word in rest)):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if rest:  # argparse does not parse patterns that come after an option
        arguments.patterns = [*arguments.patterns, *rest]

    around = arguments.verb == "record" and (arguments.before_s, arguments.after_s) != (None, None)
    if around and arguments.when is None:
        parser.error("--before and --after need --when: without a condition, record stores everything from now on")

    module = MODULES.get(arguments.verb, arguments.verb)
    execute = load(f"shmio.cli.recordings.{module}:{arguments.verb}")
    with exit_on_signals():  # so that an unfinished file is removed
        return run(PROGRAM, lambda: execute(arguments), arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Record a running instance, and examine recordings.")
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, text: str) -> argparse.ArgumentParser:
        return verbs.add_parser(name, help=text, description=text)

    record = verb("record", "record what an instance's sources publish from now on; Ctrl-C ends it")
    record.add_argument("-c", dest="config", type=Path, metavar="FILE", help="the instance of this supervisor.toml")
    record.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")
    record.add_argument(
        "-o",
        dest="directory",
        type=Path,
        default=Path("dumps"),
        metavar="DIR",
        help="directory of the files (default: dumps)",
    )
    record.add_argument("--for", dest="duration_s", type=_seconds, metavar="SECONDS", help="stop after this time")
    record.add_argument(
        "--source", dest="sources", nargs="+", action="extend", metavar="NAME", help="only these sources"
    )
    record.add_argument(
        "--register",
        dest="registers",
        nargs="+",
        action="extend",
        metavar="PATH",
        help="only these registers: paths or globs",
    )

    record.add_argument(
        "--when", metavar="CONDITION", help="record only the time around moments at which this condition is true"
    )
    for option, what in (
        ("--before", "before the condition becomes true"),
        ("--after", "after the condition was last true"),
    ):
        record.add_argument(
            option, dest=f"{option[2:]}_s", type=_amount, metavar="SECONDS",
            help=f"with --when: time to record {what} (default 10)",
        )  # fmt: skip

    add_json(record, "print events as one JSON object per line")

    note = verb("note", "put a note into the events of a running instance, and so into its recordings")
    note.add_argument("text", metavar="TEXT")
    note.add_argument("-c", dest="config", type=Path, metavar="FILE", help="the instance of this supervisor.toml")
    note.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")
    note.add_argument(
        "--source",
        metavar="NAME",
        help="source whose events get the note (default: grpc.default_source, or the first source)",
    )

    info = verb("info", "describe recordings")
    info.add_argument("files", nargs="+", type=Path, metavar="FILE")
    add_json(info, SOME_FILES)

    verify = verb("verify", "read recordings completely, and report damage; exit status 1 if there is any")
    verify.add_argument("files", nargs="+", type=Path, metavar="FILE")
    add_json(verify, SOME_FILES)

    recover = verb("recover", "write the intact parts of a damaged recording to a new file")
    recover.add_argument("file", type=Path, metavar="FILE")
    _output(recover, "the new file (default: FILE-recovered.mem)", required=False)

    cut = verb("cut", "write a part of a recording to a new file")
    cut.add_argument("files", nargs="+", type=Path, metavar="FILE")
    _output(cut, "the new file")
    _times(cut)
    _some(cut)
    add_json(cut)

    fetch = verb("fetch", "write a part of a cell's history, which the servers of a fabric keep, to a new file")
    fetch.add_argument("place", metavar="nats://HOST:PORT/PLANT.LINE.CELL")
    add_access(fetch)
    _output(fetch, "the new file")
    _times(fetch, "2026-11-21T08:30:00")
    add_json(fetch)

    export = verb("export", "write values for other programs: Parquet, CSV, or MCAP for viewers")
    export.add_argument("files", nargs="+", metavar="FILE", help="recordings, or nats://HOST:PORT/PLANT.LINE.CELL")
    add_access(export)
    _output(export, "the new file, or for tables a new folder with a file for each block")
    export.add_argument(
        "--format",
        choices=("parquet", "csv", "mcap"),
        help="default: from the ending of the new file's name, else parquet",
    )
    _times(export)
    _some(export)
    export.add_argument("--events", action="store_true", help="write a table of the events instead of the values")
    export.add_argument(
        "--raw", action="store_true", help="write the values that sources delivered, without injections"
    )

    add_json(export)

    diff = verb("diff", "compare two recordings; exit status 1 if they differ")
    diff.add_argument("files", nargs=2, type=Path, metavar="FILE")
    _some(diff)
    diff.add_argument(
        "--ignore",
        nargs="+",
        action="extend",
        default=[],
        type=_ignorable,
        metavar="WHAT",
        help=f"ignore differences in: {', '.join(IGNORABLE)}",
    )
    diff.add_argument(
        "--tolerance",
        type=_amount,
        default=0.0,
        metavar="X",
        help="ignore differences of REAL and LREAL values up to this",
    )
    diff.add_argument(
        "--relative",
        type=_amount,
        default=0.0,
        metavar="X",
        help="ignore differences up to this fraction of the larger value",
    )
    add_json(diff)

    merge = verb("merge", "write several recordings of one run to one new file")
    merge.add_argument("files", nargs="+", type=Path, metavar="FILE")
    _output(merge, "the new file")

    campaign = verb("campaign", "write the injections as a campaign, which shmio inject --file repeats")
    campaign.add_argument("files", nargs="+", type=Path, metavar="FILE")
    _output(campaign, "the new file, such as campaign.toml")
    campaign.add_argument(
        "--from-zero", action="store_true", help="let the first injection begin at 0, for shmio inject --from-now"
    )

    cat = verb("cat", "print changes of values, events and gaps")
    cat.add_argument("file", type=Path, metavar="FILE")
    cat.add_argument("patterns", nargs="*", metavar="PATH", help="register, element, structure or glob (default: all)")
    _times(cat)
    add_full(cat)
    forms = cat.add_mutually_exclusive_group()
    add_json(forms, "print one JSON object per line")
    forms.add_argument("--csv", action="store_true", help="print CSV")
    return parser


def _output(verb: argparse.ArgumentParser, text: str, *, required: bool = True) -> None:
    verb.add_argument("-o", dest="output", type=Path, required=required, metavar="FILE", help=text)


def _times(verb: argparse.ArgumentParser, form: str = "2026-11-21T08:30:00, or seconds of the recording") -> None:
    for option, what in (("--from", "begin"), ("--to", "end")):
        verb.add_argument(option, dest=what, metavar="TIME", help=f"{what} at this time: {form}")


def _some(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--source", dest="sources", nargs="+", action="extend", metavar="NAME", help="only these sources")
    verb.add_argument(
        "--only", nargs="+", action="extend", metavar="PATH", help="only these registers, structures or globs"
    )


def _ignorable(text: str) -> str:
    for word in text.split(","):
        if word not in IGNORABLE:
            raise argparse.ArgumentTypeError(unknown("part", word, IGNORABLE))
    return text


def _amount(text: str) -> float:
    return _number(text, lambda amount: 0 <= amount < math.inf, "a number from 0 on")


def _seconds(text: str) -> float:
    return _number(text, lambda seconds: 0 < seconds <= 1e9, "a number of seconds above 0")


def _number(text: str, fits: Callable[[float], bool], what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not fits(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return number


if __name__ == "__main__":
    sys.exit(main())
