"""The benchmarks of single mechanisms still run, check what they time, and print ratios. Not how fast anything is."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"^(\S.*?) +(\d+) +(\d+)(?: +(\d+\.\d+) times as fast)?$", re.MULTILINE)


def rows(benchmark: str) -> list[tuple[str, ...]]:
    """Run a benchmark; (contender, best, median, ratio or '') of every row it prints."""
    command = [sys.executable, f"benchmarks/{benchmark}.py", "--quick"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert (run.returncode, run.stderr) == (0, ""), run.stdout
    found = [match.groups("") for match in ROW.finditer(run.stdout)]
    assert all(float(value) > 0 for _, best, median, _ in found for value in (best, median))
    return found


@pytest.mark.parametrize(
    ("benchmark", "tables", "ours", "peers"),
    [
        ("shared_memory", 2, "shmio Ring", {"copy alone (the limit)", "multiprocessing.Lock, copy"}),
        ("s7_read", 9, "shmio", {"python-snap7 db_read", "shmio, one request at a time"}),
    ],
)
def test_a_benchmark_compares(benchmark: str, tables: int, ours: str, peers: set[str]) -> None:
    found = rows(benchmark)
    assert [(name, ratio) for name, _, _, ratio in found].count((ours, "")) == tables
    for peer in peers:
        assert sum(name == peer and ratio != "" for name, _, _, ratio in found) == tables


def test_cycles_under_way_are_counted() -> None:
    command = [sys.executable, "benchmarks/s7_cycle.py", "--quick"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert (run.returncode, run.stderr) == (0, ""), run.stdout
    assert len(re.findall(r"^[0-9]+ jobs: [124] under way +[1-9]", run.stdout, re.MULTILINE)) == 3
