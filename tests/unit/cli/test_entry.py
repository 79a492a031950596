"""The console scripts, as the shell starts them."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from shmio import __version__
from shmio.layout.model import Layout, Register
from shmio.segment import BlockSpec, Segment

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
NAMES = ("shmio", "shmio_campaign", "shmio_dump", "shmio_layout", "shmio_supervisor")


@pytest.mark.parametrize("name", NAMES)
def test_each_script_starts_its_command(name: str) -> None:
    program = f"import sys; from shmio.cli import entry; sys.argv[1:] = ['--version']; sys.exit(entry.{name}())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"shmio {__version__}\n", "")


@pytest.mark.parametrize("place", ["before", "after"])
def test_ctrl_c_before_or_after_the_command_prints_no_traceback(place: str) -> None:
    """Ctrl-C comes during the first imports or at the interpreter's exit; the signal ends the process."""
    program = ["import atexit, os, signal", "interrupt = lambda: os.kill(os.getpid(), signal.SIGINT)"]
    program += ["signal.signal(signal.SIGINT, signal.default_int_handler)"]  # the test run may ignore it
    program += ["from shmio.cli import entry", "import sys; sys.argv[1:] = ['--version']"]
    program += ["interrupt()"] if place == "before" else ["atexit.register(interrupt)"]
    program += ["try: entry.shmio()", "except SystemExit: pass"]
    done = subprocess.run([sys.executable, "-c", "\n".join(program)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


@pytest.mark.parametrize("name", NAMES)
def test_ctrl_c_during_imports_prints_no_traceback(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED.format(name=name)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


SWALLOWED = """
import importlib.abc, os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # the test run may ignore it
class Interrupting(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {library!r}:
            try:
                os.kill(os.getpid(), signal.SIGINT)
                sum(range(1000))
            except KeyboardInterrupt:
                pass
sys.meta_path.insert(0, Interrupting())
from shmio.cli import entry
sys.argv[1:] = {words!r}
sys.exit(entry.{name}())
"""


@pytest.mark.parametrize(
    ("name", "words", "library"),
    [
        ("shmio", ["step", "--instance", "not-there"], "msgspec"),
        ("shmio", ["get", "--host", "unix:no.sock", "cell/a"], "grpc"),
        ("shmio_campaign", ["judge", "no.mem", "-f", "no.toml"], "shmio.cli.campaigns.judge"),
        ("shmio_dump", ["info", "no.mem"], "shmio.cli.recordings.examine"),
        ("shmio_supervisor", ["status", "--instance", "not-there"], "shmio.cli.instance.status"),
        ("shmio_supervisor", ["up", "-c", "no.toml"], "shmio.cli.instance.up"),
    ],
)
def test_ctrl_c_that_an_import_swallows_still_ends_the_command(name: str, words: list[str], library: str) -> None:
    """C code may swallow KeyboardInterrupt and continue with a half-imported library."""
    program = SWALLOWED.format(name=name, words=words, library=library)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


@pytest.mark.parametrize("words", [["get"], ["get", "--json"], ["watch", "-n", "1"]])
def test_ctrl_c_that_an_import_for_reading_swallows_still_ends_the_command(instance: str, words: list[str]) -> None:
    layout = Layout("DB1", 1, 4, False, (Register("a", "REAL", (), 0, None, 4, 1),))
    with Segment.create(instance, [BlockSpec("cell", layout, 20_000_000, 3600 * 10**9, 1 << 16)], []) as segment:
        segment.writer("cell").publish(bytes(4), cycle=1, source_ns=1)
        program = SWALLOWED.format(
            name="shmio", words=[*words, "--instance", instance, "cell/a"], library="shmio.layout.values.codec"
        )
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        segment.unlink()
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_command_to_another_host_does_not_wait_for_the_threads_of_grpc() -> None:
    program = ["import atexit, sys; from shmio.cli import entry", "atexit.register(print, 'waited')"]
    program += ["sys.argv[1:] = ['get', '--host', 'unix:no.sock', 'cell/a']", "sys.exit(entry.shmio())"]
    done = subprocess.run([sys.executable, "-c", "\n".join(program)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "there is no such socket" in done.stderr
