"""Completion of command lines, tested in real shells."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmio.cli.user import main
from shmio.layout.model import Layout, Register
from shmio.segment import BlockSpec, ProcessSpec, Segment
from shmio.testing.cell import BIN
from tests.unit.cli.terminal import Terminal
from tests.unit.recording.build import varied

LAYOUT = Layout(
    "DB1",
    1,
    8,
    False,
    tuple(Register(path, "INT", (), 2 * at, None, 2, 1) for at, path in enumerate(("Axis/Pos", "Axis/Speed", "Mode"))),
)
PATH = f"{BIN}{os.pathsep}{os.environ['PATH']}"
PROMPT = "READY> "


@pytest.fixture(autouse=True)
def running(instance: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Create a running instance, and a folder with a recording and another file."""
    monkeypatch.chdir(tmp_path)
    varied(tmp_path / "kept.mem")
    Path("kept.txt").touch()
    processes = [ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]
    with Segment.create(instance, [BlockSpec("cell", LAYOUT, 20_000_000, 10**10, 1 << 16)], processes) as segment:
        yield
        segment.unlink()


def fish(line: str) -> str:
    command = f'shmio completion fish | source; complete --do-complete "{line}"'
    done = subprocess.run(
        ["fish", "--no-config", "-c", command],
        env=os.environ | {"PATH": PATH, "HOME": str(Path.cwd())},
        capture_output=True,
        text=True,
        check=True,
    )
    [word] = done.stdout.splitlines()
    return line[: line.rindex(" ") + 1] + word.partition("\t")[0]


def interactive(words: list[str], begin: str) -> Callable[[str], str]:
    """Return a function that completes a line in an interactive shell by the Tab key."""

    def complete(line: str) -> str:
        with Terminal(*words, PATH=PATH, HOME=str(Path.cwd())) as terminal:
            terminal.type(f"{begin} && PS1='REA''DY'\n")
            terminal.until("READY")
            terminal.type(f"{line}\t#")
            shown = terminal.until("#")
        plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]|\x1b[=>]|[\r\a#]", "", shown)
        return re.sub(r".\x08", "", plain).rstrip()

    return complete


SHELLS: dict[str, Callable[[str], str]] = {
    "bash": interactive(["bash", "--norc", "-i"], "source <(shmio completion bash)"),
    "zsh": interactive(["zsh", "-f", "-i"], "autoload -U compinit && compinit -D -u && source <(shmio completion zsh)"),
    "fish": fish,
}


@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize(
    ("line", "completed"),
    [
        ("shmio wat", "shmio watch"),
        ("shmio-supervisor status --inst", "shmio-supervisor status --instance"),
        ("shmio get --instance {part}", "shmio get --instance {instance}"),
        ("shmio get --instance {instance} cell/Axis/P", "shmio get --instance {instance} cell/Axis/Pos"),
        ("shmio set --instance {instance} cell/A", "shmio set --instance {instance} cell/Axis/"),
        ("shmio-dump info k", "shmio-dump info kept.mem"),
    ],
)
def test_shells_complete(shell: str, line: str, completed: str, instance: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    names = {"instance": instance, "part": instance[:-2]}
    assert SHELLS[shell](line.format(**names)) == completed.format(**names)


def candidates(line: str) -> list[str]:
    """Return the candidates that every shell gets for a line."""
    program = line.split(maxsplit=1)[0]
    answer = Path("answer")
    variables = {
        "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "COMP_LINE": line, "COMP_POINT": str(len(line)),
    }  # fmt: skip
    done = subprocess.run([BIN / program], env=os.environ | variables, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    return sorted(answer.read_text().split())


@pytest.mark.parametrize(
    ("line", "there_are"),
    [
        ("shmio get --instance {} ", ["cell/"]),
        ("shmio watch --instance {} cell/", ["cell/Axis/", "cell/Mode"]),
        ("shmio list --instance {} Axis/", ["Axis/Pos", "Axis/Speed"]),
        ("shmio replay --instance {} to-change cell/M", ["cell/Mode"]),
        ("shmio-dump record --instance {} --source ", ["cell"]),
        ("shmio-supervisor restart --instance {} ", ["cell", "grpc"]),
        ("shmio-supervisor logs --instance {} ", ["cell", "grpc", "supervisor"]),
        ("shmio-dump cut kept.mem -o x.mem --source ", ["cell", "press"]),
        ("shmio-dump cat kept.mem press/", ["press/count", "press/on", "press/row", "press/speed"]),
        ("shmio-dump cat kept.txt press/", []),
        ("shmio get --instance no-such ", []),
        ("shmio get --host 127.0.0.1:1 ", []),
        ("shmio completion ", ["bash", "fish", "zsh"]),
    ],
)
def test_candidates_after_a_line(line: str, there_are: list[str], instance: str) -> None:
    assert candidates(line.format(instance)) == there_are


def test_an_unknown_shell_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["completion", "csh"])
    assert stop.value.code == 2
    assert "choose from" in capsys.readouterr().err
