"""Stores failing cases. Each case has its own folder, with a campaign file, its recording and its report."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from shmio.config.campaign import campaign_text
from shmio.errors import RecordingError
from shmio.falsification.pool import START_S
from shmio.falsification.trial import Result

CAMPAIGN: Final = "campaign.toml"
RECORDING: Final = "run.mem"
REPORT: Final = "report.html"


class Stored(NamedTuple):
    """A stored case.

    Attributes:
        folder: Folder of the case.
        sha256: SHA-256 of the contents of the recording (:func:`shmio.recording.digest.digest_of_contents`).
        problem: Why the case cannot be repeated; empty if two runs gave equal results.

    """

    folder: Path
    sha256: str
    problem: str


def tables_for(tables: dict[str, Any], campaign: Path, config: Path, folder: Path) -> dict[str, Any]:
    """Return a campaign's tables for a new file in ``folder``, with all paths relative to this folder.

    Args:
        tables: The tables of a campaign.
        campaign: The campaign file from which the tables come.
        config: The ``supervisor.toml`` of the campaign.
        folder: The folder of the new file.

    """

    def relative(path: Path) -> str:
        return os.path.relpath(path.resolve(), folder.resolve())

    expect = [
        {**one, "like": relative(campaign.parent / one["like"])} if "like" in one else one for one in tables["expect"]
    ]
    return {"config": "", **tables} | {"config": relative(config), "expect": expect}


def store(
    folder: Path, name: str, tables: dict[str, Any], result: Result, comment: Sequence[str], limit_s: float
) -> Stored:
    """Store a failing case as a campaign file, and run the file twice, each time in a new process.

    Args:
        folder: Folder of the search.
        name: Name of the case's folder.
        tables: The tables of the campaign, from :func:`tables_for`.
        result: The result of the case in the search.
        comment: Lines about the case, for a comment in the file.
        limit_s: Maximum duration of each run in s.

    Raises:
        RecordingError: A file cannot be written, or the campaign cannot be run or takes too long.

    """
    place = folder / name
    file, recording = place / CAMPAIGN, place / RECORDING
    try:
        shutil.rmtree(place, ignore_errors=True)  # from a search that was killed
        place.mkdir()
        file.write_text(campaign_text(tables, comment))
        first = _run(file, limit_s, "--record", recording)
        recording.unlink()
        sha256 = first.get("contents_sha256", "")
        repeat = shlex.join(["shmio-campaign", "run", str(file), "--lab"])
        about = [*comment, f"Repeat it: {repeat}", f"Contents of {RECORDING}: sha256 {sha256}"]
        file.write_text(campaign_text(tables, about))
        second = _run(file, limit_s, "--record", recording, "--report", place / REPORT)
    except OSError as error:
        shutil.rmtree(place, ignore_errors=True)
        raise RecordingError(
            f"{error.filename or place}: {error.strerror}: the case is not stored; make room, and continue with "
            "--resume"
        ) from None
    except RecordingError:
        shutil.rmtree(place, ignore_errors=True)
        raise
    problem = ""
    if _seen(first) != _wanted(result) or second.get("contents_sha256") != sha256:
        problem = (
            "it does not repeat: its runs differ. Does a model have a state outside its object, "
            "another clock, or randomness of its own?"
        )
    return Stored(place, sha256, problem)


def _run(file: Path, limit_s: float, *options: str | Path) -> dict[str, Any]:
    command = [
        sys.executable,
        "-P",
        "-m",
        "shmio.cli.campaign",
        "run",
        str(file),
        "--lab",
        "--json",
        *map(str, options),
    ]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=limit_s + START_S, check=False, process_group=0
        )  # in a group of its own, so that Ctrl-C does not cut the run short
    except subprocess.TimeoutExpired:
        raise RecordingError(f"{file}: the run took longer than {limit_s:g} s (--limit)") from None
    try:
        found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        found = {"error": f"its process ended with status {done.returncode}"}
    if "verdicts" not in found:
        raise RecordingError(f"{file}: the case is not stored, because it does not run: {found.get('error')}")
    return found


def _seen(run: dict[str, Any]) -> list[tuple[str, str, float | None]]:
    return [(one["name"], one["outcome"], one["moment_s"]) for one in run["verdicts"]]


def _wanted(result: Result) -> list[tuple[str, str, float | None]]:
    return [(one.name, str(one.outcome), one.moment_s) for one in result.expectations]
