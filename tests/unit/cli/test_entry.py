"""The console scripts, as the shell starts them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from shmio import __version__

INTERRUPTED = """
import importlib.abc, sys
class Interrupting(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "argparse":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupting())
from shmio.cli import entry
sys.argv[1:] = ["--version"]
sys.exit(entry.{name}())
"""
NAMES = ("shmio", "shmio_dump", "shmio_layout", "shmio_supervisor")


@pytest.mark.parametrize("name", NAMES)
def test_each_script_is_its_command(name: str) -> None:
    program = f"import sys; from shmio.cli import entry; sys.argv[1:] = ['--version']; sys.exit(entry.{name}())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"shmio {__version__}\n", "")


@pytest.mark.parametrize("name", NAMES)
def test_ctrl_c_while_it_loads_is_no_traceback(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED.format(name=name)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
