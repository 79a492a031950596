"""``shmio fabric``: its verbs and their arguments."""

from __future__ import annotations

import argparse
from pathlib import Path

from shmio.cli.common import add_full, add_json, add_verbs, at_least, load, seconds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verbs to the parser of ``shmio fabric``."""
    verbs = add_verbs(parser, "fabric_verb")

    def verb(name: str, text: str) -> argparse.ArgumentParser:
        return verbs.add_parser(name, help=text, description=text)

    servers = _server_options()

    def fleet(name: str, text: str, json: str) -> argparse.ArgumentParser:
        made = verbs.add_parser(name, help=text, description=text, parents=[servers])
        add_json(made, json)
        return made

    cells = fleet("cells", "List all cells with their state, host and version.", "print a JSON list; with -f, lines")
    cells.add_argument(
        "-f", "--follow", action="store_true", help="continue to print cells that appear, are late or down, or change"
    )
    fleet("status", "Print the state of a cell and of its sources.", "print one JSON object").add_argument(
        "cell", metavar="CELL", help="name of the cell, such as plant1.line3.a50"
    )
    watch = fleet("watch", "Print registers of any cells whenever they change.", "print a JSON object for each change")
    watch.add_argument(
        "watched", nargs="+", metavar="PATTERN", help="cell and path, such as 'plant1.*.*/cell/Outputs/13'"
    )
    watch.add_argument("-n", dest="count", type=at_least(1), metavar="N", help="stop after N lines")
    add_full(watch)
    top = fleet("top", "Print rate, size, lag and quality of each source, again and again.", "print JSON lines")
    top.add_argument(
        "--every", dest="every_s", type=seconds, default=1.0, metavar="SECONDS", help="the interval (default: 1)"
    )
    top.add_argument("-n", dest="count", type=at_least(1), metavar="N", help="stop after N intervals")

    _add_archive(
        fleet("archive", "Write the histories of cells to Parquet files, until it is stopped.", "print JSON lines")
    )
    _add_server_config(
        verb("server-config", "Write the configuration of NATS servers, and a seed for each cell and viewer.")
    )
    prepare = fleet("prepare", "Create the registry on the servers, once, as their administrator.", "print JSON")
    prepare.add_argument(
        "--replicas", type=at_least(1), default=1, metavar="N", help="number of servers that keep the data (default: 1)"
    )
    prepare.add_argument(
        "--history", nargs="+", default=[], metavar="CELL", help="also create the histories of these cells"
    )
    for name, text in (("days", "time (default: 7 days)"), ("mb", "size of each history (default: 1000 MB)")):
        keep = f"with --history: the {text}, as keep_{name} in [fabric.history] of the cells"
        prepare.add_argument(f"--keep-{name}", type=float, metavar=name.upper(), help=keep)


def execute(options: argparse.Namespace) -> int:
    """Run the verb."""
    return load(f"shmio.cli.fabric.{options.fabric_verb.replace('-', '_')}:execute")(options)


def _server_options() -> argparse.ArgumentParser:
    """Return the options that name the servers."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(
        "--server", action="append", metavar="URL", help="a NATS server, such as nats://10.76.0.5:4222; repeatable"
    )
    parser.add_argument(
        "--credentials", metavar="FILE", help="with --server: a seed or .creds file, if the server needs one"
    )
    parser.add_argument("--ca", metavar="FILE", help="with --server: use TLS, and trust this authority (PEM)")
    parser.add_argument("--certificate", metavar="FILE", help="client certificate (PEM), if the server needs one")
    parser.add_argument("--key", metavar="FILE", help="its key (PEM)")
    parser.add_argument("-c", dest="config", type=Path, metavar="FILE", help="use [fabric] of this supervisor.toml")
    parser.add_argument("--instance", metavar="NAME", help="use [fabric] of a running instance (default: the only one)")
    return parser


def _add_archive(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="DIR", help="the folder of the archive")
    text = "archive only these cells, such as 'plant1.*.*'; repeatable"
    parser.add_argument("--cell", dest="cells", action="append", metavar="PATTERN", help=text)
    text = "close the files of a cell when one of them has this size (default: 128)"
    parser.add_argument("--close-mb", type=at_least(1), default=128, metavar="MB", help=text)
    text = "close the files of a cell when they have this age (default: 600)"
    parser.add_argument("--close-after", type=seconds, default=600.0, metavar="SECONDS", help=text)


def _add_server_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", dest="directory", type=Path, required=True, metavar="DIR", help="the folder to write")
    for option, dest, name, text in (
        ("--cell", "cells", "CELL", "add cells, such as plant1.line3.a50"),
        ("--viewer", "viewers", "NAME", "add users who may read everything and write nothing"),
        ("--history-reader", "readers", "NAME", "add viewers who may also read the histories of the cells"),
        ("--farm-user", "farm_users", "NAME", "add users for searches and workers of a farm, who see no cells"),
    ):
        parser.add_argument(option, dest=dest, nargs="+", action="extend", default=[], metavar=name, help=text)
    text = "address for clients (default: 127.0.0.1:4222); several: one for each server of a cluster"
    parser.add_argument("--listen", nargs="+", metavar="HOST:PORT", help=text)
    text = "a server keeps its data in the folder jetstream there (default: DIR)"
    parser.add_argument("--store", type=Path, metavar="FOLDER", help=text)
    parser.add_argument("--certificate", metavar="FILE", help="use TLS: the certificate of the servers (PEM)")
    parser.add_argument("--key", metavar="FILE", help="its key (PEM)")
    parser.add_argument("--ca", metavar="FILE", help="require from clients a certificate of this authority (PEM)")
    parser.add_argument("--insecure", action="store_true", help="let other hosts connect without TLS")
    add_json(parser)
