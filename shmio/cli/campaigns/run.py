"""``shmio-campaign run``: runs a campaign on an instance or in a laboratory, and judges its expectations."""

from __future__ import annotations

import argparse
import secrets
import shlex
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shmio import control
from shmio.campaigns.digests import of_campaign, of_configuration, of_layouts
from shmio.campaigns.live import LiveRun, Plan
from shmio.cli.campaigns.reports import Reports, check_place
from shmio.cli.campaigns.verdicts import UNDECIDED, tell
from shmio.cli.common import say, stop_on_signals
from shmio.cli.instance.control import clear, stop
from shmio.cli.instance.detach import start
from shmio.cli.target import Target, target
from shmio.config.campaign import Campaign, CampaignFile, read_settings
from shmio.config.declaration import with_seed
from shmio.config.read import located
from shmio.errors import ConfigError, ControlError, NotRunningError, RecordingError, ShmioError
from shmio.judging.expectation import faults_of_texts
from shmio.lab import Laboratory, prepare_laboratory
from shmio.recorder.recorder import AttachedFiles, ConfigFiles, no_attachments
from shmio.recording.digest import digest_of_contents
from shmio.recording.dump import open_dump
from shmio.segment import Segment, running_instances
from shmio.wording import EXISTS, counted

SEED_BITS: Final = 32
WHERE_S: Final = 2.0


def run(arguments: argparse.Namespace) -> int:
    """Run a campaign, print the verdicts, and write the reports.

    Raises:
        ConfigError: The campaign or the configuration is invalid.
        ShmioError: The instance does not start, does not run, or cannot be controlled.

    """
    read = CampaignFile(arguments.campaign)
    campaign = read.at(read_settings(arguments.settings))
    if arguments.config is None and arguments.instance is None:
        arguments.config = configuration_of(arguments.campaign, campaign)
    duration_s = duration_of(arguments, campaign)
    read.refuse(faults_of_texts(campaign.expect))  # before an instance is started
    if arguments.record is not None and arguments.record.exists():
        raise ConfigError(f"--record {arguments.record}: {EXISTS}")
    check_place("--record", arguments.record)
    reports = Reports(arguments)
    reports.check()
    seed = secrets.randbits(SEED_BITS) if arguments.seed is None else arguments.seed
    step_ms = arguments.step_ms or (None if arguments.real_time else campaign.step_ms)
    plan = Plan(
        [with_seed(one, seed) for one in campaign.injection],
        campaign.expect,
        duration_s,
        arguments.campaign.parent,
        None if step_ms is None else step_ms / 1000,
        arguments.real_time,
        arguments.stop,
        arguments.record,
        arguments.start or campaign.start,
    )
    facts = [*of_campaign(arguments.campaign, campaign.expect), ("seed", str(seed))]
    with stop_on_signals() as over:
        execute = _in_laboratory if arguments.lab else _on_instance
        name, work = execute(_Run(arguments, campaign, plan, reports, facts, over))
    how = f"virtual, steps of {work.step_s * 1000:g} ms" if work.virtual else "real"
    facts += [("instance", name), ("time", how), ("duration", f"{duration_s:g} s")]
    facts += [] if work.start is None else [("start", f"snapshot {work.start.name}, {work.start.time_ns / 1e9:g} s")]
    command = _command(arguments, seed, duration_s, work)
    found: dict[str, Any] = {"instance": name, "seed": seed, "virtual": work.virtual, "command": command}
    if work.recorded and work.virtual:
        # The recording may have been removed.
        with suppress(RecordingError, OSError), open_dump(arguments.record) as dump:
            found["contents_sha256"] = digest_of_contents(dump)
    status = tell(work.judge, found, as_json=arguments.json)
    if "contents_sha256" in found and not arguments.json:
        say(f"{arguments.record}: contents sha256 {found['contents_sha256']}", sys.stderr)
    title = f"Campaign {arguments.campaign.name}"
    for warning in reports.write(work.judge, title, facts, command, work.injections.spans, plan.injections):
        say(warning, sys.stderr)
    if work.problem is not None:
        say(f"{'the run ended early: ' * work.ended_early}{work.problem}", sys.stderr)
        return status or UNDECIDED
    if over.is_set():
        say("the run ended early, by a signal", sys.stderr)
        return status or UNDECIDED
    return status


def configuration_of(file: Path, campaign: Campaign) -> Path | None:
    """Return the configuration that a campaign names; None if it names none."""
    return None if campaign.config is None else file.parent / campaign.config


def duration_of(arguments: argparse.Namespace, campaign: Campaign) -> float:
    """Return how long to run a campaign, in s.

    Raises:
        ConfigError: Neither the campaign file nor the command line gives the duration.

    """
    duration_s: float | None = arguments.for_s or campaign.duration_s
    if duration_s is None:
        raise ConfigError(
            f"{arguments.campaign}: duration_s: give this key or --for S, to say how long the campaign runs"
        )
    return duration_s


@dataclass(frozen=True)
class _Run:
    """A run of a campaign: what the user asked for, and where the results go.

    ``facts`` are the names and values for the report, and ``over`` ends the run when it is set.
    """

    arguments: argparse.Namespace
    campaign: Campaign
    plan: Plan
    reports: Reports
    facts: list[tuple[str, str]]
    over: threading.Event


def _in_laboratory(run: _Run) -> tuple[str, LiveRun]:
    """Run the campaign in this process, without an instance. Return the instance's name and the run."""
    file: Path | None = run.arguments.config
    named: Path = run.arguments.campaign
    if file is None:
        raise ConfigError(f"{named}: name the configuration with -c FILE, or with the key config of the campaign")
    if run.arguments.real_time:
        raise ConfigError("--real-time: the time of a laboratory is always virtual")
    prepared = prepare_laboratory(file)
    with located(named if run.campaign.parameters else file):
        made = Laboratory(prepared, run.campaign.parameters)
    with made as lab, located(named):
        work = lab.prepare(run.plan, run.reports.collector(lambda: work.judge))
        run.facts.extend(of_configuration(file))
        run.facts.extend(of_layouts({block.source: block.layout for block in prepared.blocks}))
        work.run(run.over, lambda: _told(run, "laboratory", work))
    return prepared.instance, work


def _on_instance(run: _Run) -> tuple[str, LiveRun]:
    """Run the campaign on an instance. Return the instance's name and the run."""
    if run.campaign.parameters:
        raise ConfigError(
            f"{run.arguments.campaign}: parameters: an instance cannot change the parameters of its models; use --lab, "
            "or set them in supervisor.toml"
        )
    named = run.arguments.campaign
    with (
        _instance(run.arguments) as (wanted, started),
        _opened(wanted, run.arguments) as segment,
        located(named),
    ):
        note = "; the instance was started for this run" if started else "; the instance was already running"
        file = _configuration(segment)
        attachments: AttachedFiles = no_attachments if file is None else ConfigFiles(file)
        run.facts.extend([] if file is None else of_configuration(file))
        run.facts.extend(of_layouts({source: block.layout for source, block in segment.blocks.items()}))
        work = LiveRun(segment, run.plan, attachments, run.reports.collector(lambda: work.judge))
        work.run(run.over, lambda: _told(run, wanted.name, work, note))
    return wanted.name, work


@contextmanager
def _instance(arguments: argparse.Namespace) -> Iterator[tuple[Target, bool]]:
    """Yield the instance, and whether this run has started it. With ``-c``, start it if it does not run.

    Stop it at the end if this run has started it, even if its supervisor has died meanwhile.

    Raises:
        ConfigError: The configuration cannot be used.
        ControlError: The instance does not start.

    """
    wanted = target(arguments)
    name = wanted.name
    if arguments.config is None or name in running_instances():
        yield wanted, False
        with suppress(NotRunningError), wanted.open() as segment:
            if not segment.supervised:
                say(f"shmio-supervisor down --instance {name} stops what the dead supervisor left", sys.stderr)
        return
    try:
        start(arguments.config, "live")
    except ControlError:
        with suppress(ShmioError):  # the error of the start counts
            _clear(name)
        raise
    try:
        yield wanted, True
    finally:
        try:
            _stop(name)
        except (ShmioError, OSError) as error:  # the verdicts still count
            say(f"instance {name} is not stopped: {error}", sys.stderr)


def _stop(instance: str) -> None:
    """Stop an instance, even if its supervisor is dead."""
    with suppress(NotRunningError), Segment.open(instance) as segment:
        if segment.supervised:
            stop(segment)
            return
    _clear(instance)


def _clear(instance: str) -> None:
    """Stop the processes that a dead supervisor has left, and say so."""
    for line in clear(instance):
        say(line, sys.stderr)


def _opened(wanted: Target, arguments: argparse.Namespace) -> Segment:
    """Open the instance.

    Raises:
        NotRunningError: The instance does not run; the message says which option starts it.

    """
    try:
        return wanted.open(writable=True)
    except NotRunningError as error:
        if wanted.file is None or arguments.config is not None:
            raise
        raise NotRunningError(f"{error}; or add -c {wanted.file}, with which the run starts and stops it") from None


def _configuration(segment: Segment) -> Path | None:
    """Return the configuration file of an instance; None if its supervisor does not tell it."""
    try:
        return Path(control.request(segment.header.control, control.Where(), WHERE_S)["config"])
    except (ControlError, KeyError):
        return None


def _told(run: _Run, instance: str, work: LiveRun, note: str = "") -> None:
    campaign, plan = run.campaign, run.plan
    if run.arguments.json:
        return
    how = f"virtual time, steps of {work.step_s * 1000:g} ms" if work.virtual else "real time"
    if work.start is not None:
        say(f"{instance}: restored {work.start.name}, {work.start.time_ns / 1e9:g} s", sys.stderr)
        for process, why in work.start.left_out.items():
            say(f"  without {process}: {why}", sys.stderr)
    injections = counted(len(campaign.injection), "injection")
    expectations = counted(len(campaign.expect), "expectation")
    say(f"{instance}: {injections}, {expectations}, {how}{note}", sys.stderr)
    seed = next(
        (laid.seed for laid, one in zip(plan.injections, campaign.injection, strict=True) if one.seed is None), None
    )
    if seed is not None:
        say(f"seed {seed}: --seed {seed} repeats this run", sys.stderr)


def _command(arguments: argparse.Namespace, seed: int, duration_s: float, work: LiveRun) -> str:
    """Return the command that repeats the run."""
    words = ["shmio-campaign", "run", str(arguments.campaign), "--seed", str(seed), "--for", f"{duration_s:.12g}"]
    if work.virtual:
        words += ["--step-ms", f"{work.step_s * 1000:.12g}"]
    words += [word for text in arguments.settings for word in ("--set", text)]
    words += ["--lab"] if arguments.lab else []
    words += ["--real-time"] if arguments.real_time else []
    words += ["--stop"] if arguments.stop else []
    words += [] if work.start is None else ["--start", work.start.name]
    if arguments.config is not None:
        words += ["-c", str(arguments.config)]
    if arguments.instance is not None:
        words += ["--instance", arguments.instance]
    return shlex.join(words)
