"""Groups of source files to break, with the tests that should notice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final


@dataclass(frozen=True)
class Group:
    """Source files and their tests, as globs from the project's root. Groups may share tests."""

    sources: tuple[str, ...]
    tests: tuple[str, ...]


GROUPS: Final = {
    "segment": Group(
        ("shmio/segment/*.py", "shmio/segment/*.h", "shmio/segment/_atomics.c", "shmio/local/*.py"),
        (
            "tests/unit/connectors/models",
            "tests/unit/connectors/replay",
            "tests/unit/connectors/test_*.py",
            "tests/unit/local",
            "tests/unit/segment",
            "tests/native",
        ),
    ),
    "s7": Group(
        ("shmio/connectors/s7/*.py", "shmio/layout/s7/*.py"),
        ("tests/unit/connectors/s7", "tests/unit/layout/s7", "tests/conformance/test_s7.py"),
    ),
    "commands": Group(
        (
            "shmio/connectors/base.py",
            "shmio/connectors/commands.py",
            "shmio/connectors/injection_layers.py",
            "shmio/connectors/injections.py",
            "shmio/connectors/poll_loop.py",
            "shmio/connectors/output.py",
            "shmio/layout/values/write.py",
            "shmio/local/writer.py",
            "shmio/segment/commands.py",
        ),
        (
            "tests/unit/connectors/test_*.py",
            "tests/unit/connectors/models",
            "tests/unit/local/test_writer.py",
            "tests/unit/layout/values/test_write.py",
            "tests/unit/segment/test_command*.py",
            "tests/unit/segment/test_segment_change.py",
        ),
    ),
    "injection": Group(
        ("shmio/injection/*.py", "shmio/injection/_numbers.c"),
        ("tests/unit/injection", "tests/unit/connectors/test_injections*.py"),
    ),
    "streams": Group(
        (
            "shmio/endpoints/grpc/encoding.py",
            "shmio/endpoints/grpc/wakeups.py",
            "shmio/endpoints/grpc/streams/*.py",
            "shmio/endpoints/grpc/commands/injections.py",
            "shmio/endpoints/grpc/services/publish.py",
            "shmio/endpoints/grpc/services/simlog_v2.py",
        ),
        (
            "tests/unit/endpoints/grpc/commands",
            "tests/unit/endpoints/grpc/services",
            "tests/unit/endpoints/grpc/streams",
            "tests/unit/endpoints/grpc/test_grpc.py",
            "tests/unit/endpoints/grpc/test_inject_v2.py",
            "tests/unit/endpoints/grpc/test_limits.py",
            "tests/unit/endpoints/grpc/test_stepping.py",
            "tests/unit/endpoints/grpc/test_structures.py",
            "tests/unit/endpoints/grpc/test_wakeups.py",
        ),
    ),
    "recorder": Group(
        ("shmio/recorder/*.py", "shmio/recording/format/records.py"),
        ("tests/unit/recorder", "tests/unit/recording"),
    ),
}


def expand(root: Path, patterns: tuple[str, ...]) -> Iterator[Path]:
    """Yield the files that match the globs. SystemExit: a glob matches no file."""
    for pattern in patterns:
        found = sorted(root.glob(pattern))
        if not found:
            raise SystemExit(f"{pattern} matches no file: correct tests/mutants/groups.py")
        yield from found
