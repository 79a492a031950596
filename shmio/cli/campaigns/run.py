"""``shmio-campaign run``: runs a campaign on an instance, and judges what it expects."""

from __future__ import annotations

import argparse
import secrets
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from shmio import control
from shmio.campaigns.digests import of_campaign, of_configuration, of_layouts
from shmio.campaigns.live import LiveRun, Plan
from shmio.cli.campaigns.reports import Reports
from shmio.cli.campaigns.verdicts import tell
from shmio.cli.common import say, stop_on_signals
from shmio.cli.instance.control import stop
from shmio.cli.instance.detach import start
from shmio.cli.target import Target, target
from shmio.config.campaign import Campaign, load_campaign
from shmio.config.declaration import with_seed
from shmio.errors import ConfigError, ControlError, DeclarationError
from shmio.judging.expectation import check_texts
from shmio.recorder.recorder import AttachedFiles, ConfigFiles, no_attachments
from shmio.segment import Segment, running_instances

SEED_BITS: Final = 32
WHERE_S: Final = 2.0
UNDECIDED: Final = 3


def run(arguments: argparse.Namespace) -> int:
    """Run a campaign, print the verdicts, and write the reports.

    Raises:
        ConfigError: The campaign or the configuration is wrong.
        ShmioError: The instance does not start, does not run, or cannot be controlled.

    """
    campaign = load_campaign(arguments.campaign)
    duration_s = arguments.for_s or campaign.duration_s
    if duration_s is None:
        raise ConfigError(
            f"{arguments.campaign}: duration_s: this key is needed, or --for S: how long the campaign runs"
        )
    try:  # before an instance is started
        check_texts(campaign.expect)
    except ConfigError as error:
        raise ConfigError(f"{arguments.campaign}: {error}") from None
    if arguments.record is not None and arguments.record.exists():
        raise ConfigError(f"--record {arguments.record}: the file exists already; no recording is overwritten")
    seed = secrets.randbits(SEED_BITS) if arguments.seed is None else arguments.seed
    plan = Plan(
        [with_seed(one, seed) for one in campaign.injection],
        campaign.expect,
        duration_s,
        arguments.campaign.parent,
        None if arguments.step_ms is None else arguments.step_ms / 1000,
        arguments.real_time,
        arguments.stop,
        arguments.record,
    )
    with stop_on_signals() as over, _instance(arguments) as wanted:
        segment = wanted.open(writable=True)
        reports = Reports(arguments)
        with segment:
            file = _configuration(segment)
            attachments: AttachedFiles = no_attachments if file is None else ConfigFiles(file)
            facts = [*of_campaign(arguments.campaign, campaign.expect), ("seed", str(seed))]
            facts += [] if file is None else of_configuration(file)
            facts += of_layouts({source: block.layout for source, block in segment.blocks.items()})
            try:
                work = LiveRun(segment, plan, attachments, reports.collector(lambda: work.judge))
                work.run(over, lambda: _told(arguments, campaign, seed, wanted.name, work))
            except (ConfigError, DeclarationError) as error:
                raise ConfigError(f"{arguments.campaign}: {error}") from None
    how = f"virtual, steps of {work.step_s * 1000:g} ms" if work.virtual else "real"
    facts += [("instance", wanted.name), ("time", how), ("duration", f"{duration_s:g} s")]
    command = _command(arguments, seed, duration_s, work)
    reports.write(work.judge, f"Campaign {arguments.campaign.name}", facts, command, work.injections.spans)
    found = {"instance": wanted.name, "seed": seed, "virtual": work.virtual, "command": command}
    status = tell(work.judge, found, as_json=arguments.json)
    if work.problem is not None:
        say(f"the run ended early: {work.problem}", sys.stderr)
        return status or UNDECIDED
    if over.is_set():
        say("the run ended early, by a signal", sys.stderr)
        return status or UNDECIDED
    return status


@contextmanager
def _instance(arguments: argparse.Namespace) -> Iterator[Target]:
    """Yield the instance. With ``-c``, start it if it does not run, and then stop it at the end.

    Raises:
        ControlError: The instance does not start.

    """
    wanted = target(arguments)
    if arguments.config is None or wanted.name in running_instances():
        yield wanted
        return
    _, started = start(arguments.config, "live")
    try:
        yield Target(started.instance, arguments.config)
    finally:
        with Segment.open(started.instance) as segment:
            stop(segment)


def _configuration(segment: Segment) -> Path | None:
    """Return the configuration file of an instance; None if its supervisor does not tell it."""
    try:
        return Path(control.request(segment.header.control, control.Where(), WHERE_S)["config"])
    except (ControlError, KeyError):
        return None


def _told(arguments: argparse.Namespace, campaign: Campaign, seed: int, instance: str, work: LiveRun) -> None:
    if arguments.json:
        return
    how = f"virtual time, steps of {work.step_s * 1000:g} ms" if work.virtual else "real time"
    say(f"{instance}: {len(campaign.injection)} injections, {len(campaign.expect)} expectations, {how}", sys.stderr)
    if any(one.seed is None for one in campaign.injection):
        say(f"seed {seed}: --seed {seed} does the same again", sys.stderr)


def _command(arguments: argparse.Namespace, seed: int, duration_s: float, work: LiveRun) -> str:
    """Return the command that repeats the run."""
    words = ["shmio-campaign", "run", str(arguments.campaign), "--seed", str(seed), "--for", f"{duration_s:.12g}"]
    if work.virtual:
        words += ["--step-ms", f"{work.step_s * 1000:.12g}"]
    words += ["--real-time"] if arguments.real_time else []
    words += ["--stop"] if arguments.stop else []
    if arguments.config is not None:
        words += ["-c", str(arguments.config)]
    if arguments.instance is not None:
        words += ["--instance", arguments.instance]
    return shlex.join(words)
