"""The C core under the sanitizers: many threads on one ring, two on one queue."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

COMPILER = shutil.which("cc") or shutil.which("gcc") or "cc"


@pytest.mark.parametrize("sanitizers", ["thread", "address,undefined"])
@pytest.mark.parametrize("name", ["ring_stress", "queue_stress"])
def test_no_sanitizer_finds_anything(name: str, sanitizers: str, tmp_path: Path) -> None:
    source, program = Path(__file__).with_name(f"{name}.c"), tmp_path / name
    # -Wno-tsan: the thread sanitizer does not model fences; all shared words are atomic, so it has no race to miss.
    command = [COMPILER, "-std=c11", "-D_DEFAULT_SOURCE", "-O1", "-g", "-Wall", "-Wextra", "-Werror", "-pthread"]
    if sanitizers == "thread":
        command.append("-Wno-tsan")
    command += [f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all", str(source), "-o", str(program)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    run = subprocess.run([program], capture_output=True, text=True, timeout=100, check=False)
    assert (run.returncode, run.stderr) == (0, "")
