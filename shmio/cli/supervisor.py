"""``shmio-supervisor``: starts, watches and stops an instance.

The verbs are in ``shmio.cli.instance``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from shmio.cli.common import add_json, add_verbs, at_least, complete, load, milliseconds, moment, run, verb_first
from shmio.control import ANSWERS
from shmio.version import __version__

PROGRAM = "shmio-supervisor"
MODES = ("live", "log", "replay")
SCHEMAS = ("supervisor", "campaign", "scene")


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``shmio-supervisor`` and return its exit status."""
    parser = _parser()
    complete(parser)
    arguments = parser.parse_args(verb_first(sys.argv[1:] if argv is None else argv))

    detach = arguments.verb == "up" and arguments.detach
    execute = load(f"shmio.cli.instance.{'detach:detach' if detach else arguments.command}")
    return run(PROGRAM, lambda: execute(arguments), arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Start, watch and stop an instance.")
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    verbs = add_verbs(parser)

    file = argparse.ArgumentParser(add_help=False)
    file.add_argument("-c", dest="config", type=Path, metavar="FILE", help="configuration (default: supervisor.toml)")
    target = argparse.ArgumentParser(add_help=False, parents=[file])
    target.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")

    def verb(name: str, text: str, *parents: argparse.ArgumentParser, command: str = "") -> argparse.ArgumentParser:
        """Add a verb. ``command``: MODULE:FUNCTION in ``shmio.cli.instance``; default: the name."""
        made = verbs.add_parser(name, help=text, description=text, parents=parents)
        made.set_defaults(command=command or f"{name}:{name}")
        return made

    up = verb("up", "start the instance; Ctrl-C, SIGTERM or closing the terminal stops it", file)
    up.add_argument(
        "--mode",
        choices=MODES,
        default="live",
        help="live (default); log: record, serve nothing; replay: play a recording in place of the sources",
    )
    up.add_argument(
        "--detach", action="store_true", help="start the instance in the background, and return when it runs"
    )
    _add_replay(up)
    up.add_argument("--report", type=int, help=argparse.SUPPRESS)  # descriptor for the report of a detached start
    verb("down", "stop the instance", target, command="control:down")
    add_json(verb("status", "show the state of the instance and its processes", target))
    text = "list the instances on this host, their files and the addresses on which they listen"
    add_json(verb("list", text, command="status:list_instances"), "print a JSON list")
    text = "apply changes of the configuration; leave everything else alone"
    reload = verb("reload", text, target, command="control:reload")
    text = "print what it would stop, start, restart and inject, and change nothing"
    reload.add_argument("--dry-run", action="store_true", help=text)
    add_json(reload)
    text = "restart one process, as it was configured at the start or the last reload"
    verb("restart", text, target, command="control:restart").add_argument("name", metavar="NAME")
    text = "change how an emulator answers its clients, to rehearse faults; its section needs faults = true"
    emulator = verb("emulator", text, target)
    emulator.add_argument("name", metavar="NAME", help="the name of an [[emulator]]")
    text = "ok: as usual; delay: later; corrupt: with wrong bytes; hang: not at all; refuse: no connections"
    emulator.add_argument("answers", choices=ANSWERS, help=text)
    emulator.add_argument(
        "--delay-ms", type=milliseconds, metavar="MS", help="with delay: the delay of each answer (default: 100)"
    )
    check = verb("check", "validate the configuration and its layouts; start nothing", file)
    text = "say whether each source can meet its period if the answer to a request takes this long"
    check.add_argument("--round-trip-ms", type=milliseconds, metavar="MS", help=text)
    add_json(check)
    logs = verb("logs", "print the end of the log files", target)
    logs.add_argument("name", metavar="NAME", nargs="?", help="a process, or supervisor (default: all)")
    logs.add_argument("-f", "--follow", action="store_true", help="continue to print new lines until Ctrl-C")
    text = "number of lines to print, of all processes together (default: 20)"
    logs.add_argument("-n", "--lines", type=at_least(0), default=20, metavar="LINES", help=text)
    add_json(logs, "print one JSON object per line")
    audit = verb("audit", "print who did what to the instance, from where, and with what outcome", target)
    audit.add_argument(
        "pattern", metavar="PATTERN", nargs="?", help="only entries about this register or name; * is a wildcard"
    )
    audit.add_argument("-f", "--follow", action="store_true", help="continue to print new entries until Ctrl-C")
    text = "maximum number of entries to print (default: 50, or all with --since)"
    audit.add_argument("-n", "--lines", type=at_least(0), metavar="LINES", help=text)
    text = "only entries from then on: 30s, 10m, 2h or 7d before now, or a date and time"
    audit.add_argument("--since", type=moment, metavar="TIME", help=text)
    audit.add_argument(
        "--who", metavar="NAME", help="only entries of this token, account, certificate, user number or kind of user"
    )
    audit.add_argument("--action", metavar="ACTION", help="only entries with this action, such as write or restart")
    add_json(audit, "print one JSON object per line")
    init = verb("init", "write a configuration: the A50 example, or one for the files given", file)
    init.usage = (
        f"{PROGRAM} init [-h] [-c FILE] [--demo | --emulated] [--block NAME] [plc.ini] [FILE.db [FILE.udt ...]]"
    )
    init.epilog = (
        "A device without source files of data blocks has a tag table, which a [[source]] names as its layout: "
        "shmio-layout import converts the tag list of another tool, shmio-supervisor browse asks a device that can "
        "list its values, and docs/how-to/use-a-tag-list.md says how to write one."
    )
    init.add_argument(
        "--demo", action="store_true", help="the A50 example with its emulated PLC; the same as without files"
    )
    init.add_argument("--emulated", action="store_true", help="with an emulated PLC in place of the real one")
    init.add_argument("--block", metavar="NAME", help="only this data block (default: a source for each)")
    init.add_argument(
        "files",
        metavar="FILE",
        nargs="*",
        type=Path,
        help="source files of data blocks (.db, .udt, .scl), optionally after a plc.ini",
    )
    text = "print the JSON schema of a file, with which editors complete and check its keys"
    verb("schema", text).add_argument(
        "file", metavar="KIND", nargs="?", choices=SCHEMAS, default="supervisor",
        help="supervisor (default), campaign or scene",
    )  # fmt: skip
    text = "write the instance as an FMU for co-simulation (FMI 2.0); all its sources must be computed"
    export = verb("export-fmu", text, file, command="export_fmu:export_fmu")
    export.add_argument("-o", dest="output", type=Path, required=True, metavar="FILE.fmu", help="the FMU to write")
    export.add_argument(
        "--only", nargs="+", default=[], metavar="PATTERN", help="only these registers; * and ** are wildcards"
    )
    _add_browse(verb("browse", "list what a device offers, as a tree or as a tag table"))
    text = "write a package with a connector of your own, which works and has tests; change its protocol"
    new = verb("new-connector", text, command="new_connector:new_connector")
    new.add_argument(
        "connector", metavar="NAME", help='name of the connector: you write connector = "NAME" in supervisor.toml'
    )
    new.add_argument("-o", dest="directory", type=Path, metavar="FOLDER", help="the new folder (default: shmio-NAME)")
    return parser


def _add_browse(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("url", metavar="URL", help="the device, such as opc.tcp://10.76.0.30:4840 or ros2://0")
    parser.add_argument("paths", metavar="PATTERN", nargs="*", help="list only these paths; * and ** are wildcards")
    parser.add_argument("-o", dest="output", type=Path, metavar="FILE.toml", help="write a tag table, a new file")
    parser.add_argument("--writable", action="store_true", help="with -o: commands may write what the device permits")
    text = "the connector that reads the device (default: the one for this kind of URL)"
    parser.add_argument("--connector", metavar="NAME", help=text)
    text = "a key of the source, such as security=SignAndEncrypt or username=operator; repeatable"
    parser.add_argument("--set", dest="keys", action="append", default=[], metavar="KEY=VALUE", help=text)
    parser.add_argument(
        "--depth", type=at_least(1), default=32, metavar="LEVELS", help="levels to search (default: 32)"
    )
    text = "maximum number of nodes to look at (default: 100000)"
    parser.add_argument("--limit", type=at_least(1), default=100_000, metavar="NODES", help=text)


def _add_replay(parser: argparse.ArgumentParser) -> None:
    """Add the options that override the keys of ``[replay]``."""
    group = parser.add_argument_group("with --mode replay, in place of the keys of [replay]")
    group.add_argument("--from", nargs="+", metavar="FILE", help="the recording: one .mem, or several of one run")
    group.add_argument(
        "--start", metavar="TIME", help="where to start: seconds from the recording's beginning, or a date and time"
    )
    group.add_argument("--end", metavar="TIME", help="where to end, in the same form as --start")
    group.add_argument(
        "--speed", type=float, metavar="X", help="the speed relative to real time, 0.01 to 1000 (default: 1)"
    )
    group.add_argument(
        "--injections", choices=("keep", "leave out"), help="what to do with the recording's injections (default: keep)"
    )
    group.add_argument("--loop", action="store_true", default=None, help="at the end, begin again")
    group.add_argument(
        "--paused", action="store_true", default=None, help="wait at the beginning until you run shmio replay play"
    )
    group.add_argument("--record", action="store_true", default=None, help="start the recorder of the configuration")


if __name__ == "__main__":
    sys.exit(main())
