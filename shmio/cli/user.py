"""``shmio``: reads, writes and controls a running instance on this host or another."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from shmio.cli.common import add_json, add_verbs, complete, ended_by_interrupt, load, run, verb_first
from shmio.config.address import UNIX, Address
from shmio.errors import ConfigError, UnknownClientError
from shmio.layout.spelling import may_be_tia_spelling, topic_path
from shmio.model.cell import Cell
from shmio.version import __version__

PROGRAM = "shmio"

FABRIC_HELP = "See all cells of a fabric, and configure its servers: see docs/how-to/join-hosts.md."
SHELL_HELP = "Print the code with which a shell completes command lines: see docs/reference/cli-shmio.md."


class Verb(NamedTuple):
    """A verb that acts on an instance.

    Attributes:
        help: Its help.
        arguments: Module and function that add its arguments to a parser.
        execute: Module and function that run it.
        writable: Whether it may change the instance.
    """

    help: str
    arguments: str
    execute: str
    writable: bool = True


# Each command imports the modules of its own verb only.
VERBS = {
    "list": Verb(
        "List registers with their types.",
        "shmio.cli.read:list_arguments",
        "shmio.cli.read:list_registers",
        writable=False,
    ),
    "get": Verb(
        "Print the present values of registers, with quality and age.",
        "shmio.cli.read:get_arguments",
        "shmio.cli.read:get",
        writable=False,
    ),
    "watch": Verb(
        "Print registers whenever they change, the present values first; on a terminal, as a table.",
        "shmio.cli.read:watch_arguments",
        "shmio.cli.read:watch",
        writable=False,
    ),
    "set": Verb(
        "Write values of registers, and print the result of each.", "shmio.cli.set:arguments", "shmio.cli.set:execute"
    ),
    "inject": Verb(
        "Give consumers, or with /in the device, other values until Ctrl-C.",
        "shmio.cli.inject:arguments",
        "shmio.cli.inject:execute",
    ),
    "step": Verb(
        "Step the instance's time: after the first step only steps move it, until it is released.",
        "shmio.cli.step:arguments",
        "shmio.cli.step:execute",
    ),
    "snapshot": Verb(
        "Save the state of an instance in virtual time, and restore it.",
        "shmio.cli.snapshot:arguments",
        "shmio.cli.snapshot:execute",
    ),
    "replay": Verb(
        "Show how recordings play, and control them: pause, play, seek, and more.",
        "shmio.cli.replay:arguments",
        "shmio.cli.replay:execute",
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``shmio`` and return its exit status."""
    words = verb_first(sys.argv[1:] if argv is None else argv)
    chosen = words[0] if words else ""
    parser = _parser(chosen)
    complete(parser)
    if chosen in ("set", "inject"):
        from shmio.cli.set import shield  # noqa: PLC0415

        words = shield(words)
    arguments = parser.parse_args(words)

    def command() -> int:
        if arguments.verb == "fabric":
            return load("shmio.cli.fabric.verbs:execute")(arguments)
        verb: Verb | None = VERBS.get(arguments.verb)
        if verb is None:
            from shmio.cli.completion import script  # noqa: PLC0415

            print(script(arguments.shell))
            return 0
        execute = load(verb.execute)
        with _opened(arguments, writable=verb.writable) as cell:
            return execute(cell, _spelled(cell, arguments))

    return run(PROGRAM, command, arguments)


@contextmanager
def _opened(arguments: argparse.Namespace, *, writable: bool) -> Iterator[Cell]:
    """Open the instance that the options name.

    With ``--host``, it is the instance behind an endpoint.

    Raises:
        ConfigError: ``--host`` was combined with options for an instance on this host, or the
            address is invalid.
        OSError: A file cannot be read.
        ValueRangeError: The token would be sent to another host in plain text.
        UnknownClientError: The instance requires a token; the message names the option for it.

    """
    if arguments.host is None:
        if find_spec("shmio.local") is None:  # the distribution shmio-client
            raise ConfigError(
                "name the instance with --host HOST:PORT: shmio-client reaches instances only by gRPC (on Linux, "
                "pip install shmio also reads the shared memory of this host)"
            )
        from shmio.cli.target import target  # noqa: PLC0415  not part of shmio-client
        from shmio.local.attach import Attachment  # noqa: PLC0415

        with Attachment(target(arguments).open(writable=writable)) as attachment:
            yield attachment
        return
    if arguments.config is not None or arguments.instance is not None:
        raise ConfigError("--host already names the instance; remove -c and --instance")
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # shmio's own errors say the same
    with ended_by_interrupt():  # gRPC crashes if an exception interrupts its import
        from shmio.client import connect  # noqa: PLC0415  only for --host
    if not arguments.host.startswith(UNIX):
        Address.parse(arguments.host)
    token = arguments.token_file.read_text().strip() if arguments.token_file else None
    with connect(
        arguments.host,
        ca=arguments.ca,
        certificate=arguments.certificate,
        key=arguments.key,
        token=token,
        token_in_plain_text=arguments.token_in_plain_text,
    ) as client:
        try:
            yield client
        except UnknownClientError as error:
            if token is not None:
                raise
            raise UnknownClientError(f"{error}; give --token-file FILE, a file with only the token") from None


def _spelled(cell: Cell, arguments: argparse.Namespace) -> argparse.Namespace:
    """Return the arguments, with paths in TIA Portal's spelling converted to shmio's spelling."""
    patterns, pairs = getattr(arguments, "patterns", None) or (), getattr(arguments, "pairs", None) or ()
    if not any(map(may_be_tia_spelling, [*patterns, *(path for path, _ in pairs)])):
        return arguments
    layouts = cell.layouts()
    default = next(iter(layouts)) if len(layouts) == 1 else None
    if patterns:
        arguments.patterns = [topic_path(path, layouts, default) for path in patterns]
    if pairs:
        arguments.pairs = [(topic_path(path, layouts, default), text) for path, text in pairs]
    return arguments


def _parser(chosen: str = "") -> argparse.ArgumentParser:
    """Return the parser. If ``chosen`` is a verb, the other verbs have no arguments."""
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Read and write the registers of a running instance.")
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("-c", dest="config", type=Path, metavar="FILE", help="the instance of this supervisor.toml")
    common.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")
    add_json(common, "print JSON")
    common.add_argument("--host", metavar="HOST:PORT", help="an instance's gRPC endpoint, on any host; or unix:PATH")
    common.add_argument(
        "--ca",
        type=Path,
        metavar="FILE",
        help="with --host: use TLS, and trust certificates of this authority (PEM)",
    )
    common.add_argument(
        "--certificate", type=Path, metavar="FILE", help="client certificate (PEM), if the endpoint needs one"
    )
    common.add_argument("--key", type=Path, metavar="FILE", help="its key (PEM)")
    common.add_argument("--token-file", type=Path, metavar="FILE", help="a file with the token of this client")
    common.add_argument(
        "--token-in-plain-text", action="store_true", help="send the token to another host even without TLS"
    )
    verbs = add_verbs(parser)

    def needs(name: str) -> bool:
        return chosen == name or chosen not in (*VERBS, "fabric", "completion")

    for name, verb in VERBS.items():
        sub = verbs.add_parser(name, parents=[common], help=verb.help, description=verb.help)
        if needs(name):
            load(verb.arguments)(sub)
    if find_spec("shmio.fabric") is not None:  # not part of shmio-client
        sub = verbs.add_parser("fabric", help=FABRIC_HELP, description=FABRIC_HELP)
        if needs("fabric"):
            load("shmio.cli.fabric.verbs:add_arguments")(sub)
    sub = verbs.add_parser("completion", help=SHELL_HELP, description=SHELL_HELP)
    if needs("completion"):
        from shmio.cli.completion import SHELLS  # noqa: PLC0415

        sub.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))
    return parser
