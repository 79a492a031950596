"""Stress tests of the C core under sanitizers, and models of it that are explored exhaustively."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

COMPILER = shutil.which("cc") or shutil.which("gcc") or "cc"


@pytest.mark.parametrize("sanitizers", ["thread", "address,undefined"])
@pytest.mark.parametrize("name", ["ring_stress", "frames_stress", "queue_stress"])
def test_sanitizers_find_nothing(name: str, sanitizers: str, tmp_path: Path) -> None:
    source, program = Path(__file__).with_name(f"{name}.c"), tmp_path / name
    # -Wno-tsan: the thread sanitizer does not model fences. All shared words are atomic, so it misses no race.
    command = [COMPILER, "-std=c11", "-D_DEFAULT_SOURCE", "-O1", "-g", "-Wall", "-Wextra", "-Werror", "-pthread"]
    if sanitizers == "thread":
        command.append("-Wno-tsan")
    command += [f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all", str(source), "-o", str(program)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    run = subprocess.run([program], capture_output=True, text=True, timeout=100, check=False)
    assert (run.returncode, run.stderr) == (0, "")


@pytest.mark.parametrize("name", ["relay_model", "ring_orders"])
def test_the_models_find_no_error(name: str, tmp_path: Path) -> None:
    """No interleaving loses a wake-up or keeps a stopped relay running, and the memory orders suffice."""
    source, program = Path(__file__).with_name(f"{name}.c"), tmp_path / name
    command = [COMPILER, "-std=gnu11", "-D_GNU_SOURCE", "-O1", "-Wall", "-Wextra", "-Werror", str(source)]
    subprocess.run([*command, "-o", str(program)], check=True, capture_output=True, text=True)
    run = subprocess.run([program], capture_output=True, text=True, timeout=100, check=False)
    assert (run.returncode, run.stderr) == (0, "")
