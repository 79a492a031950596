"""``shmio-dump campaign``: what was injected in recordings as a file for ``shmio inject --file``."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import msgspec

from shmio.cli.recordings.damage_report import DamageReport
from shmio.cli.run import say
from shmio.config.declaration import check_declarations
from shmio.errors import ConfigError, RecordingError
from shmio.logs import printable
from shmio.recording.campaign import derive
from shmio.recording.rewriting import new_file


def execute(arguments: argparse.Namespace) -> int:
    """Write the injections of some files of one run; what cannot be declared is told."""
    report = DamageReport()
    with report.open(arguments.files) as dump:
        found = derive(dump)
    for text in found.left_out:
        print(printable(f"not as it was: {text}"), file=sys.stderr)
    if not found.declarations:
        raise RecordingError(f"{dump.files[0]}: no injection was laid in it that can be declared")
    declarations = found.shifted(found.begin_s) if arguments.from_zero else found.declarations
    try:
        check_declarations(declarations)
    except ConfigError as error:
        raise RecordingError(f"{dump.files[0]}: its injections make no campaign: {error}") from None
    tables = [_table(msgspec.to_builtins(one)) for one in declarations]
    with new_file(arguments.output) as stream:
        stream.write("\n".join(tables).encode())
    say(f"{arguments.output}: {len(tables)} injections; shmio inject --file {arguments.output} lays them")
    return int(report.any)


def _table(keys: dict[str, Any]) -> str:
    return "".join(["[[injection]]\n", *(f"{key} = {_text(value)}\n" for key, value in keys.items())])


def _text(value: Any) -> str:
    """As TOML has it, whose texts without control characters, numbers and lists are JSON's."""
    return json.dumps(value, ensure_ascii=False)
