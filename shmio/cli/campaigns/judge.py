"""``shmio-campaign judge``: judges a campaign's expectations over a recording."""

from __future__ import annotations

import argparse

from shmio.cli.campaigns.verdicts import tell
from shmio.cli.recordings.common import DamageReport, time_range
from shmio.config.campaign import load_campaign
from shmio.errors import ConfigError
from shmio.recording.judge import judge_recording


def judge(arguments: argparse.Namespace) -> int:
    """Judge a recording, and print the verdicts.

    Raises:
        ConfigError: The campaign is wrong.
        RecordingError: A file is not a recording.

    """
    campaign = load_campaign(arguments.campaign)
    report = DamageReport()
    with report.open(arguments.files) as dump:
        begin, end = time_range(arguments, dump.begin_ns)
        try:
            found = judge_recording(dump, campaign.expect, begin, end)
        except ConfigError as error:
            raise ConfigError(f"{arguments.campaign}: {error}") from None
    return tell(found, {"files": [str(file) for file in arguments.files]}, as_json=arguments.json)
