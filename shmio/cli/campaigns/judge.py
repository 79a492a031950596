"""``shmio-campaign judge``: judges a campaign's expectations over a recording."""

from __future__ import annotations

import argparse
import errno
import os
import shlex
import sys

from shmio.campaigns.digests import of_campaign, of_file, of_layouts
from shmio.cli.campaigns.reports import Reports
from shmio.cli.campaigns.verdicts import tell
from shmio.cli.common import say
from shmio.cli.recordings.common import DamageReport, not_closed, time_range
from shmio.config.campaign import CampaignFile
from shmio.config.read import located
from shmio.errors import ConfigError, RecordingError
from shmio.recording.injection_times import InjectionTimes
from shmio.recording.judge import GoldenRecordings, judge_recording, recording_judge


def judge(arguments: argparse.Namespace) -> int:
    """Judge a recording, and print the verdicts.

    Raises:
        ConfigError: The campaign or an option is invalid, or a file does not exist.
        RecordingError: A file is not a recording.

    """
    expectations = CampaignFile(arguments.campaign).expect  # its injections are not laid, so they may have ranges
    reports = Reports(arguments)
    reports.check()
    for file in arguments.files:
        if not file.exists():
            raise ConfigError(f"{file}: {os.strerror(errno.ENOENT)}")
    report = DamageReport()
    with report.open(arguments.files) as dump:
        try:
            begin, end = time_range(arguments, dump.begin_ns)
        except RecordingError as error:  # wrong usage
            raise ConfigError(str(error)) from None
        with located(arguments.campaign):
            found = recording_judge(dump, expectations, GoldenRecordings(arguments.campaign.parent))
            judge_recording(dump, found, begin, end, reports.collector(lambda: found))
        times = InjectionTimes()
        for _, block, event in dump.events(None, begin, end):
            if block is not None:
                times.follow(block.source, event)
        facts = [*of_campaign(arguments.campaign, expectations)]
        facts += [("recording", f"{file}, sha256 {of_file(file)}") for file in arguments.files]
        facts += of_layouts({block.source: block.layout for block in dump.blocks})
        upto = "" if found.end_ns is None else f"; judged up to {(found.end_ns - 1) / 1e9:.3f} s"
        for reader in dump.readers:
            if not reader.records.closed:
                say(f"{reader.file}: {not_closed(reader.records.damage)}{upto}", sys.stderr)
    words = ["shmio-campaign", "judge", *map(str, arguments.files), "-f", str(arguments.campaign)]
    for option, text in (("--from", arguments.begin), ("--to", arguments.end)):
        words += [] if text is None else [option, text]
    status = tell(found, {"files": [str(file) for file in arguments.files]}, as_json=arguments.json)
    for warning in reports.write(found, f"Campaign {arguments.campaign.name}", facts, shlex.join(words), times.spans):
        say(warning, sys.stderr)
    return status
