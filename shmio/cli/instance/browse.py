"""``shmio-supervisor browse``: lists the values that a device offers, as a tree or as a tag table."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import msgspec

from shmio.config.address import check_host
from shmio.connectors import registry
from shmio.connectors.base import Connector
from shmio.connectors.browsing import Browsed, Offer, Wanted
from shmio.errors import ConfigError
from shmio.files import create_file
from shmio.layout.importing.found import Found
from shmio.plan.sources import named_hosts
from shmio.wording import EXISTS, NOT_TOML, printable, unknown


def browse(arguments: argparse.Namespace) -> int:
    """List the values that a device offers; return 1 if the list is incomplete."""
    output = arguments.output
    if output is not None and output.suffix != ".toml":
        raise ConfigError(f"{output}: {NOT_TOML}")
    if output is not None and output.exists():
        raise ConfigError(f"{output}: {EXISTS}")
    wanted = Wanted(arguments.paths, depth=arguments.depth, nodes=arguments.limit)
    connector, options = _connector(arguments.url, arguments.connector, arguments.keys)
    found = connector.browse(options, wanted)
    if output is not None:
        _write(arguments, found)
    else:
        for line in tree(found.offers):
            print(printable(line))
    if found.incomplete:
        print(printable(f"this list is incomplete: {found.incomplete}"), file=sys.stderr)
    elif not found.offers:
        remedy = " that matches the patterns; browse without patterns lists all; write %2F for a / inside a name"
        raise ConfigError(f"{arguments.url}: the device offers nothing{remedy if arguments.paths else ''}")
    return 1 if found.incomplete else 0


def _connector(url: str, name: str | None, keys: list[str]) -> tuple[type[Connector], Any]:
    """Return the connector for a URL, and its options."""
    name = name or _name(url)
    connector = registry.load(name)
    if not issubclass(connector, Connector):
        raise ConfigError(f"connector {name} reads no device, so there is nothing to browse")
    given = connector.browse_options(url)
    for _, host in named_hosts(given):
        try:
            check_host(host)
        except ConfigError as error:
            raise ConfigError(f"{url}: {error}") from None
    texts: dict[str, str] = {}
    for pair in keys:
        key, equals, value = pair.partition("=")
        if not equals:
            raise ConfigError(f"--set {pair}: expected KEY=VALUE")
        texts[key] = value
    known = {field.encode_name for field in msgspec.structs.fields(connector.Options)} - given.keys()
    if others := texts.keys() - known:
        raise ConfigError(f"--set: {unknown('key', min(others), sorted(known), f'connector {name}')}")
    return connector, registry.convert_options(name, given, texts)


def _name(url: str) -> str:
    """Return the name of the connector that can browse a URL, or that at least says why it cannot."""
    scheme = urlsplit(url).scheme
    by_scheme = {form.partition(":")[0]: name for form, name in registry.BROWSED.items()}
    if scheme in by_scheme:
        return by_scheme[scheme]
    if scheme in registry.names():
        return scheme
    raise ConfigError(
        f"{url}: shmio cannot browse a device with this kind of URL; valid: {', '.join(registry.BROWSED)}; "
        "for a connector of another package, add --connector NAME, such as --connector mtconnect for http://HOST:PORT"
    )


def _write(arguments: argparse.Namespace, found: Browsed) -> None:
    table = Found("a device")
    for one in found.offers:
        if one.type:
            table.add(one.names, one.type, one.columns)
        elif one.refused:
            table.skip("/".join(one.names), one.refused)
    for line in table.report():
        print(printable(line), file=sys.stderr)
    if not table.tags:
        raise ConfigError(f"{arguments.url}: the device offers nothing that a tag table can hold")
    try:
        create_file(arguments.output, table.to_toml(arguments.url, writable=arguments.writable).encode())
    except FileExistsError:
        raise ConfigError(f"{arguments.output}: {EXISTS}") from None


def tree(offers: list[Offer]) -> Iterator[str]:
    """Yield the lines of a tree of values: each group, followed by its contents."""
    by_names = {one.names: one for one in offers}
    children: dict[tuple[str, ...], dict[tuple[str, ...], None]] = {}
    for names in by_names:
        for length in range(len(names), 0, -1):  # a pattern may leave out the groups above
            children.setdefault(names[: length - 1], {})[names[:length]] = None
    waiting = list(reversed(children.get((), {})))
    while waiting:
        names = waiting.pop()
        one = by_names.get(names, Offer(names))
        text = "  " * (len(names) - 1) + names[-1]
        columns = one.columns
        more = [one.type or (f"({one.refused})" if one.refused else ""), str(columns.get("address", ""))]
        more += [str(columns.get("unit", "")), "writable" if columns.get("writable") else ""]
        yield "  ".join([text, *filter(None, more)])
        waiting += reversed(children.get(names, {}))
