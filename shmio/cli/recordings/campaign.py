"""``shmio-dump campaign``: writes the injections of recordings as a campaign file."""

from __future__ import annotations

import argparse
import sys

from shmio.cli.common import say
from shmio.cli.recordings.common import DamageReport
from shmio.config.campaign import Campaign, campaign_text, tables_of
from shmio.config.declaration import check_declarations
from shmio.errors import ConfigError, RecordingError
from shmio.recording.campaign import derive
from shmio.recording.rewriting import new_file
from shmio.wording import counted, printable


def campaign(arguments: argparse.Namespace) -> int:
    """Write the injections in the files of one run as a campaign; report those that a campaign cannot declare."""
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
    with new_file(arguments.output) as stream:
        stream.write(campaign_text(tables_of(Campaign(injection=list(declarations)))).encode())
    creates = f"shmio inject --file {arguments.output} creates {'it' if len(declarations) == 1 else 'them'}"
    say(f"{arguments.output}: {counted(len(declarations), 'injection')}; {creates}")
    return int(report.any)
