"""``shmio-dump campaign``: writes the injections of recordings as a campaign file."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import msgspec

from shmio.cli.common import say
from shmio.cli.recordings.common import DamageReport
from shmio.config.declaration import check_declarations
from shmio.errors import ConfigError, RecordingError
from shmio.logs import printable
from shmio.recording.campaign import derive
from shmio.recording.rewriting import new_file


def campaign(arguments: argparse.Namespace) -> int:
    """Write the injections in files of one run; report injections that cannot be declared."""
    report = DamageReport()
    with report.open(arguments.files) as dump:
        found = derive(dump)
    for text in found.left_out:
        print(printable(f"not exactly reproduced: {text}"), file=sys.stderr)
    if not found.declarations:
        raise RecordingError(f"{dump.files[0]}: it has no injection that can be declared")
    declarations = found.shifted(found.begin_s) if arguments.from_zero else found.declarations
    try:
        check_declarations(declarations)
    except ConfigError as error:
        raise RecordingError(f"{dump.files[0]}: its injections cannot form a campaign: {error}") from None
    tables = [_table(msgspec.to_builtins(one)) for one in declarations]
    with new_file(arguments.output) as stream:
        stream.write("\n".join(tables).encode())
    say(f"{arguments.output}: {len(tables)} injections; shmio inject --file {arguments.output} creates them")
    return int(report.any)


def _table(keys: dict[str, Any]) -> str:
    return "".join(["[[injection]]\n", *(f"{key} = {_text(value)}\n" for key, value in keys.items())])


def _text(value: Any) -> str:
    """Return a value as TOML.

    Numbers, lists and texts without control characters look as in JSON.
    """
    return json.dumps(value, ensure_ascii=False)
