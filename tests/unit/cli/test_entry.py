"""The console scripts, as the shell starts them."""

from __future__ import annotations

import signal
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


@pytest.mark.parametrize("place", ["before", "after"])
def test_ctrl_c_before_and_after_its_command_is_no_traceback(place: str) -> None:
    """While the script that is installed imports us, and while the interpreter ends: it dies as shells expect."""
    program = ["import atexit, os, signal", "interrupt = lambda: os.kill(os.getpid(), signal.SIGINT)"]
    program += ["signal.signal(signal.SIGINT, signal.default_int_handler)"]  # a test may run with it ignored
    program += ["from shmio.cli import entry", "import sys; sys.argv[1:] = ['--version']"]
    program += ["interrupt()"] if place == "before" else ["atexit.register(interrupt)"]
    program += ["try: entry.shmio()", "except SystemExit: pass"]
    done = subprocess.run([sys.executable, "-c", "\n".join(program)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


@pytest.mark.parametrize("name", NAMES)
def test_ctrl_c_while_it_loads_is_no_traceback(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED.format(name=name)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
