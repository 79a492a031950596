"""Clients on another host: a network namespace with a virtual cable to this one."""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmio.testing.cell import CONFIG, PATIENCE_S, Cell

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("ip") is None, reason="needs root and iproute2 to make a network namespace"
)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


@pytest.fixture
def other_host() -> Iterator[tuple[str, str]]:
    """Yield the namespace's name and this host's address on the cable."""
    tag = secrets.token_hex(3)
    host, ours, theirs = f"shmio-{tag}", f"sh{tag}a", f"sh{tag}b"
    third = secrets.randbelow(250)
    ip("netns", "add", host)
    try:
        ip("link", "add", ours, "type", "veth", "peer", "name", theirs, "netns", host)
        ip("addr", "add", f"10.213.{third}.1/30", "dev", ours)
        ip("link", "set", ours, "up")
        ip("-n", host, "addr", "add", f"10.213.{third}.2/30", "dev", theirs)
        ip("-n", host, "link", "set", theirs, "up")
        yield host, f"10.213.{third}.1"
    finally:
        ip("netns", "delete", host)


def test_another_host_receives_changing_values(make_cell: Callable[..., Cell], other_host: tuple[str, str]) -> None:
    host, address = other_host
    cell = make_cell(config=CONFIG.replace('listen = ["{grpc}"]', f'listen = ["{{grpc}}", "{address}:{{grpc.port}}"]'))
    refused = cell.supervisor("check")
    assert refused.returncode == 1
    assert "insecure = true" in refused.stderr
    file = cell.folder / "supervisor.toml"
    file.write_text(file.read_text() + "insecure = true\n")
    cell.up()
    client = [sys.executable, str(ROOT / "examples/subscribe.py"), "--count", "5"]
    done = subprocess.run(
        ["ip", "netns", "exec", host, *client, f"{address}:{cell.grpc.port}", "cell/Robot_800/Axs1_Pos"],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    values = {line.split()[-1] for line in done.stdout.splitlines()}
    assert len(values) > 1
    assert all(float(value) is not None for value in values)


def test_the_roles_of_an_address_apply_to_another_host_in_plain_text(
    make_cell: Callable[..., Cell], other_host: tuple[str, str]
) -> None:
    host, address = other_host
    token = '[[grpc.token]]\nname = "all"\nroles = ["read", "write"]\ntoken_file = "token"\n'
    exposed = f'[[grpc.address]]\nlisten = "{address}:{{grpc.port}}"\ninsecure = true\n'
    cell = make_cell(config=CONFIG + token + exposed)
    (cell.folder / "token").write_text("0123456789abcdefghijklmnop")
    (cell.folder / "token").chmod(0o600)
    cell.up()

    def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = ["ip", "netns", "exec", host, sys.executable, str(ROOT / "examples" / script), *arguments]
        return subprocess.run(command, cwd=cell.folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False)

    there, topic = f"{address}:{cell.grpc.port}", "cell/Robot_800/Axs1_Pos"
    assert run("subscribe.py", "--count", "2", there, topic).returncode == 0
    shown = run("subscribe.py", "--count", "2", "--token-file", "token", there, topic)
    assert (shown.returncode, "have this token replaced" in shown.stderr) == (1, True)
    written = run("publish.py", there, "cell/Outputs/13", "1")
    assert (written.returncode, "Publish needs the role write; this address has read" in written.stderr) == (1, True)
    local = cell.run(
        "python", str(ROOT / "examples/publish.py"), "--token-file", "token", str(cell.grpc), "cell/Outputs/13", "1"
    )
    assert local.returncode == 0, local.stderr
    refused = cell.folder / "supervisor.toml"
    refused.write_text(
        refused.read_text()
        .replace(str(cell.grpc), f"{address}:1", 1)
        .replace("[[grpc.token]]", "insecure = true\n[[grpc.token]]")
    )
    checked = cell.supervisor("check")
    assert (checked.returncode, "could read the tokens of [[grpc.token]]" in checked.stderr) == (1, True)
