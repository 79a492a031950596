"""``shmio-supervisor``: start, watch and stop an instance. Each verb is a module of ``shmio.cli.instance``."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from shmio.cli.run import add_json, at_least, complete, ended_by_interrupt, run
from shmio.plan.replay import add_arguments
from shmio.version import __version__

PROGRAM = "shmio-supervisor"
MODES = ("live", "log", "replay")


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``shmio-supervisor`` and return its exit status."""
    parser = _parser()
    complete(parser)
    arguments = parser.parse_args(argv)

    with ended_by_interrupt():
        verb = importlib.import_module(f"shmio.cli.instance.{arguments.verb}")  # each needs other parts of shmio

    def command() -> int:
        status: int = verb.execute(arguments)
        return status

    return run(PROGRAM, command, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Start, watch and stop an instance.")
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    file = argparse.ArgumentParser(add_help=False)
    file.add_argument("-c", dest="config", type=Path, metavar="FILE", help="configuration (default: supervisor.toml)")
    target = argparse.ArgumentParser(add_help=False, parents=[file])
    target.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")

    def verb(name: str, text: str, parent: argparse.ArgumentParser) -> argparse.ArgumentParser:
        return verbs.add_parser(name, help=text, description=text, parents=[parent])

    up = verb("up", "start the instance; Ctrl-C, SIGTERM or closing the terminal stops it", file)
    up.add_argument(
        "--mode",
        choices=MODES,
        default="live",
        help="live (default); log: record, serve nothing; replay: play a recording in place of the sources",
    )
    up.add_argument("--detach", action="store_true", help="return when it runs, and leave it running")
    add_arguments(up)
    up.add_argument("--report", type=int, help=argparse.SUPPRESS)  # descriptor on which a detached one tells its start
    verb("down", "stop the instance", target)
    add_json(verb("status", "show the state of the instance and its processes", target))
    text = "list the instances on this host, their files and the addresses on which they listen"
    add_json(verb("list", text, argparse.ArgumentParser(add_help=False)), "print a JSON list")
    add_json(verb("reload", "apply changes of the configuration; leave everything else alone", target))
    verb("restart", "restart one process, as it was configured at the start or the last reload", target).add_argument(
        "name", metavar="NAME"
    )
    add_json(verb("check", "validate the configuration and its layouts; start nothing", file))
    logs = verb("logs", "print the end of the log files", target)
    logs.add_argument("name", metavar="NAME", nargs="?", help="a process, or supervisor (default: all)")
    logs.add_argument("-f", "--follow", action="store_true", help="continue with new lines")
    logs.add_argument("-n", "--lines", type=at_least(0), default=20, metavar="LINES", help="default: 20")
    add_json(logs, "print one JSON object per line")
    init = verb("init", "write a configuration: the A50 example, or one for the files given", file)
    init.usage = f"{PROGRAM} init [-h] [-c FILE] [--emulated] [--block NAME] [plc.ini] [FILE.db [FILE.udt ...]]"
    init.add_argument("--emulated", action="store_true", help="with an emulated PLC in place of the real one")
    init.add_argument("--block", metavar="NAME", help="only this data block (default: a source for each)")
    init.add_argument(
        "files", metavar="FILE", nargs="*", type=Path, help="the block's sources (.db, .udt, .scl), and a plc.ini"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
