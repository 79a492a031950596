"""The ring's C core under the sanitizers: many threads, one ring."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

SOURCE = Path(__file__).with_name("ring_stress.c")
COMPILER = shutil.which("cc") or shutil.which("gcc") or "cc"


@pytest.mark.parametrize("sanitizers", ["thread", "address,undefined"])
def test_no_sanitizer_finds_anything(sanitizers: str, tmp_path: Path) -> None:
    program = tmp_path / "ring_stress"
    # -Wno-tsan: the thread sanitizer does not model fences; all shared words are atomic, so it has no race to miss.
    command = [COMPILER, "-std=c11", "-D_DEFAULT_SOURCE", "-O1", "-g", "-Wall", "-Wextra", "-Werror", "-pthread"]
    if sanitizers == "thread":
        command.append("-Wno-tsan")
    command += [f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all", str(SOURCE), "-o", str(program)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    run = subprocess.run([program], capture_output=True, text=True, timeout=100, check=False)
    assert (run.returncode, run.stderr) == (0, "")
