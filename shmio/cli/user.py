"""``shmio``: read, write and control a running instance on this host or another."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from shmio.cli import completion, get, inject, registers, replay, step, watch
from shmio.cli import set as set_verb
from shmio.cli.interrupt import ended_by_interrupt
from shmio.cli.run import add_json, complete, run
from shmio.cli.target import target
from shmio.config.address import UNIX, Address
from shmio.errors import ConfigError, UnknownClientError
from shmio.layout.spelling import may_be_tia_spelling, topic_path
from shmio.local.attach import Attachment
from shmio.model.cell import Cell
from shmio.version import __version__

PROGRAM = "shmio"

SHELL_HELP = "Print the code with which a shell completes command lines: see docs/reference/cli-shmio.md."

Verb = Callable[[Cell, argparse.Namespace], int]


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``shmio`` and return its exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    parser = _parser()
    complete(parser)
    arguments = parser.parse_args(set_verb.shield(words) if words[:1] in (["set"], ["inject"]) else words)

    def command() -> int:
        verb: Verb | None = arguments.verb
        if verb is None:
            print(completion.script(arguments.shell))
            return 0
        with _opened(arguments, writable=arguments.writable) as cell:
            return verb(cell, _spelled(cell, arguments))

    return run(PROGRAM, command, arguments)


@contextmanager
def _opened(arguments: argparse.Namespace, *, writable: bool) -> Iterator[Cell]:
    """Open the instance that the options of ``shmio`` name, here or, with ``--host``, behind an endpoint.

    Raises:
        ConfigError: ``--host`` comes with options for an instance here, or the address is invalid.
        OSError: A file cannot be read.
        ValueRangeError: The token would go to another host in plain text.
        UnknownClientError: The instance requires a token; the message has the option for it.

    """
    if arguments.host is None:
        with Attachment(target(arguments).open(writable=writable)) as attachment:
            yield attachment
        return
    if arguments.config is not None or arguments.instance is not None:
        raise ConfigError("--host names the instance already: leave out -c and --instance")
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # what is wrong it tells us, too
    with ended_by_interrupt():  # gRPC crashes when it is broken off while it is loaded
        from shmio.client import connect  # noqa: PLC0415  for those who ask for it alone
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
            raise UnknownClientError(f"{error}; here: --token-file FILE, a file with only the token") from None


def _spelled(cell: Cell, arguments: argparse.Namespace) -> argparse.Namespace:
    """Return the arguments with paths in TIA Portal's spelling translated to shmio's."""
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Read and write the registers of a running instance.")
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("-c", dest="config", type=Path, metavar="FILE", help="the instance of this supervisor.toml")
    common.add_argument("--instance", metavar="NAME", help="a running instance (default: the only one)")
    add_json(common, "print JSON")
    common.add_argument("--host", metavar="HOST:PORT", help="an instance's gRPC endpoint, on any host; or unix:PATH")
    common.add_argument("--ca", type=Path, metavar="FILE", help="with --host: use TLS, and trust this authority (PEM)")
    common.add_argument(
        "--certificate", type=Path, metavar="FILE", help="client certificate (PEM), if the endpoint needs one"
    )
    common.add_argument("--key", type=Path, metavar="FILE", help="its key (PEM)")
    common.add_argument("--token-file", type=Path, metavar="FILE", help="what the endpoint knows us by")
    common.add_argument(
        "--token-in-plain-text", action="store_true", help="send the token to another host even without TLS"
    )
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    modules = {
        "list": registers,
        "get": get,
        "watch": watch,
        "set": set_verb,
        "inject": inject,
        "step": step,
        "replay": replay,
    }
    for name, module in modules.items():
        sub = verbs.add_parser(name, parents=[common], help=module.HELP, description=module.HELP)
        module.arguments(sub)
        sub.set_defaults(verb=module.execute, writable=module in (set_verb, inject, step, replay))
    shell = verbs.add_parser("completion", help=SHELL_HELP, description=SHELL_HELP)
    shell.add_argument("shell", choices=completion.SHELLS, metavar="SHELL", help=", ".join(completion.SHELLS))
    shell.set_defaults(verb=None)
    return parser
