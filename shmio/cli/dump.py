"""``shmio-dump``: record a running instance, and examine recordings.

Each verb is a module of ``shmio.cli.recordings``.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from shmio.cli.interrupt import ended_by_interrupt, exit_on_signals
from shmio.cli.run import add_full, add_json, complete, run
from shmio.version import __version__

PROGRAM = "shmio-dump"
SOME_FILES = "print JSON: one object, or a list for several files"
IGNORABLE = ("times", "cycle", "reason", "events", "ends")
"""What ``diff`` can ignore, as in shmio.recording.compare, which only that verb imports."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``shmio-dump`` and return its exit status."""
    parser = _parser()
    complete(parser)
    arguments, rest = parser.parse_known_args(argv)
    if rest and (arguments.verb != "cat" or any(word.startswith("-") for word in rest)):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if rest:  # argparse leaves patterns that come after an option
        arguments.patterns = [*arguments.patterns, *rest]

    around = arguments.verb == "record" and (arguments.before_s, arguments.after_s) != (None, None)
    if around and arguments.when is None:
        parser.error("--before and --after are for --when: without a condition all is recorded, from now on")

    with ended_by_interrupt():
        verb = importlib.import_module(f"shmio.cli.recordings.{arguments.verb}")  # each needs other parts of shmio

    def command() -> int:
        status: int = verb.execute(arguments)
        return status

    with exit_on_signals():  # a file that is being made is removed again
        return run(PROGRAM, command, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Record a running instance, and look into recordings.")
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, text: str) -> argparse.ArgumentParser:
        return verbs.add_parser(name, help=text, description=text)

    record = verb("record", "record what an instance's sources publish from now on; Ctrl-C ends it")
    record.add_argument("-c", dest="config", type=Path, metavar="FILE", help="the instance of this supervisor.toml")
    record.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")
    record.add_argument(
        "-o", dest="directory", type=Path, default=Path("dumps"), metavar="DIR", help="where to (default: dumps)"
    )
    record.add_argument("--for", dest="duration_s", type=_seconds, metavar="SECONDS", help="end by itself")
    record.add_argument("--source", dest="sources", nargs="+", action="extend", metavar="NAME", help="only these")
    record.add_argument(
        "--register", dest="registers", nargs="+", action="extend", metavar="PATH", help="only these: paths or globs"
    )

    record.add_argument("--when", metavar="CONDITION", help="only what happens around the times when this is true")
    for option, what in (("--before", "before it is true"), ("--after", "after it was true last")):
        record.add_argument(
            option, dest=f"{option[2:]}_s", type=_amount, metavar="SECONDS",
            help=f"with --when: so much {what} (default 10)",
        )  # fmt: skip

    add_json(record, "print what goes on as a JSON object a line")

    note = verb("note", "put a note into the events of a running instance, and so into its recordings")
    note.add_argument("text", metavar="TEXT")
    note.add_argument("-c", dest="config", type=Path, metavar="FILE", help="the instance of this supervisor.toml")
    note.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")
    note.add_argument(
        "--source", metavar="NAME", help="whose events (default: grpc.default_source, or the first source)"
    )

    info = verb("info", "tell what is in recordings")
    info.add_argument("files", nargs="+", type=Path, metavar="FILE")
    add_json(info, SOME_FILES)

    verify = verb("verify", "read all of recordings, and tell what is damaged; exit status 1 if anything is")
    verify.add_argument("files", nargs="+", type=Path, metavar="FILE")
    add_json(verify, SOME_FILES)

    recover = verb("recover", "write what is whole of a damaged recording to a new file")
    recover.add_argument("file", type=Path, metavar="FILE")
    _output(recover, "the new file (default: FILE-recovered.mem)", required=False)

    cut = verb("cut", "write a part of a recording to a new file")
    cut.add_argument("files", nargs="+", type=Path, metavar="FILE")
    _output(cut, "the new file")
    _times(cut)
    _some(cut)
    add_json(cut)

    export = verb("export", "write values for other programs: Parquet, CSV, or MCAP for viewers")
    export.add_argument("files", nargs="+", type=Path, metavar="FILE")
    _output(export, "the new file, or of tables the new folder with a file for each block")
    export.add_argument(
        "--format", choices=("parquet", "csv", "mcap"), help="default: as the name of the new file ends; else parquet"
    )
    _times(export)
    _some(export)
    export.add_argument("--events", action="store_true", help="a table of the events in place of the values")
    export.add_argument("--raw", action="store_true", help="what sources delivered, without what was injected")

    add_json(export)

    diff = verb("diff", "tell where two recordings differ; exit status 1 if they do")
    diff.add_argument("files", nargs=2, type=Path, metavar="FILE")
    _some(diff)
    diff.add_argument(
        "--ignore",
        nargs="+",
        action="extend",
        default=[],
        type=_ignorable,
        metavar="WHAT",
        help=f"what may differ: {', '.join(IGNORABLE)}",
    )
    diff.add_argument("--tolerance", type=_amount, default=0.0, metavar="X", help="REAL and LREAL may differ by this")
    diff.add_argument("--relative", type=_amount, default=0.0, metavar="X", help="or by this part of the larger one")
    add_json(diff)

    merge = verb("merge", "write several recordings of one run to one new file")
    merge.add_argument("files", nargs="+", type=Path, metavar="FILE")
    _output(merge, "the new file")

    campaign = verb("campaign", "write what was injected as a campaign, which shmio inject --file does again")
    campaign.add_argument("files", nargs="+", type=Path, metavar="FILE")
    _output(campaign, "the new file, such as campaign.toml")
    campaign.add_argument(
        "--from-zero", action="store_true", help="have the first one begin at 0, for shmio inject --from-now"
    )

    cat = verb("cat", "print values as they changed, events, and what was missed")
    cat.add_argument("file", type=Path, metavar="FILE")
    cat.add_argument("patterns", nargs="*", metavar="PATH", help="register, element, structure or glob (default: all)")
    _times(cat)
    add_full(cat)
    forms = cat.add_mutually_exclusive_group()
    add_json(forms, "print a JSON object a line")
    forms.add_argument("--csv", action="store_true", help="print CSV")
    return parser


def _output(verb: argparse.ArgumentParser, text: str, *, required: bool = True) -> None:
    verb.add_argument("-o", dest="output", type=Path, required=required, metavar="FILE", help=text)


def _times(verb: argparse.ArgumentParser) -> None:
    for option, what in (("--from", "begin"), ("--to", "end")):
        verb.add_argument(
            option, dest=what, metavar="TIME", help=f"{what} there: 2026-11-21T08:30:00, or seconds of the recording"
        )


def _some(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--source", dest="sources", nargs="+", action="extend", metavar="NAME", help="only these")
    verb.add_argument(
        "--only", nargs="+", action="extend", metavar="PATH", help="only these registers, structures or globs"
    )


def _ignorable(text: str) -> str:
    for word in text.split(","):
        if word not in IGNORABLE:
            raise argparse.ArgumentTypeError(f"{word!r} is none of {', '.join(IGNORABLE)}")
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
