"""The stack of packaging/compose without its images: its cell, and a real Prometheus, with exactly its files.

Namespaces stand in for the containers: a network whose hosts have the names of the services, and the files in the
places where compose.yaml mounts them. The test does not start Grafana.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from shmio.testing.cell import BIN, until

yaml: Any = pytest.importorskip("yaml", reason="needs PyYAML, which the site's libraries bring")

ROOT = Path(__file__).parents[2]
COMPOSE = ROOT / "packaging/compose/compose.yaml"
RUNNING = "the instance is running"
"""What ``up`` prints. scripts/build-image waits for the same words."""
NAMESPACES = """
ip link set lo up
mount -t tmpfs tmpfs "$1"
mount -t tmpfs tmpfs /dev/shm
for folder in /etc /var/lib; do
    mkdir -p "$1$folder/upper" "$1$folder/work"
    mount -t overlay overlay -o "lowerdir=$folder,upperdir=$1$folder/upper,workdir=$1$folder/work" $folder
done
echo ready
exec sleep infinity
"""

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or any(shutil.which(name) is None for name in ("ip", "nsenter", "prometheus")),
    reason="needs root, iproute2, util-linux and Prometheus",
)


class Stack:
    """The namespaces, in which programs run beside each other."""

    def __init__(self, pid: int, folder: Path) -> None:
        self._enter = ["nsenter", f"--target={pid}", "--mount", "--net", "--"]
        self._environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
        self._folder = folder

    def run(self, *command: str | Path) -> str:
        """Run a command, which must succeed, and return what it prints."""
        done = subprocess.run(
            [*self._enter, *command], env=self._environment, capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    @contextmanager
    def running(self, name: str, *command: str | Path) -> Iterator[Path]:
        """Run a program meanwhile, and yield the file with what it prints."""
        printed = self._folder / f"{name}.log"
        with printed.open("w") as file:
            process = subprocess.Popen(
                [*self._enter, *command], env=self._environment, stdout=file, stderr=subprocess.STDOUT
            )
        try:
            yield printed
        finally:
            process.terminate()
            assert process.wait(60) == 0, printed.read_text()

    def get(self, url: str) -> str:
        return self.run(
            "python3", "-c", f"import urllib.request as u; print(u.urlopen({url!r}, timeout=20).read().decode())"
        )

    def prometheus(self, question: str) -> Any:
        return json.loads(self.get(f"http://prometheus:9090/api/v1/{question}"))["data"]


@pytest.fixture
def stack(tmp_path: Path) -> Iterator[Stack]:
    """Yield the namespaces of the stack, with its files in their places."""
    services = yaml.safe_load(COMPOSE.read_text())["services"]
    layers = tmp_path / "layers"
    layers.mkdir()
    command = ["unshare", "--mount", "--net", "bash", "-euc", NAMESPACES, "bash", str(layers)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stderr is not None
        if process.stdout.readline() != "ready\n":
            pytest.skip(f"this host refuses namespaces or overlays: {process.stderr.read()}")
        stack = Stack(process.pid, tmp_path)
        stack.run("sh", "-c", f"echo 127.0.0.1 {' '.join(services)} >>/etc/hosts; mkdir /var/lib/shmio")
        for name in services:
            for volume in services[name]["volumes"]:
                outside, inside, *_ = volume.split(":")
                if outside.startswith("."):
                    stack.run("install", "-D", "-m", "644", COMPOSE.parent / outside, inside)
        yield stack
    finally:
        process.kill()
        process.communicate()


def test_prometheus_of_the_stack_monitors_its_cell(stack: Stack) -> None:
    """Its target is up, its rules are loaded and none is active, and each port that compose.yaml publishes is open."""
    assert RUNNING in (ROOT / "scripts/build-image").read_text()
    config = Path("/etc/shmio/supervisor.toml")
    stack.run("promtool", "check", "config", "/etc/prometheus/prometheus.yml")
    with ExitStack() as programs:
        printed = programs.enter_context(stack.running("cell", BIN / "shmio-supervisor", "up", "-c", config))
        until(lambda: RUNNING in printed.read_text(), "a running cell")
        storage = printed.parent / "prometheus"
        programs.enter_context(
            stack.running(
                "prometheus",
                "prometheus",
                "--config.file=/etc/prometheus/prometheus.yml",
                f"--storage.tsdb.path={storage}",
            )
        )
        until(lambda: "Server is ready" in (printed.parent / "prometheus.log").read_text(), "Prometheus")
        until(lambda: {one["health"] for one in stack.prometheus("targets")["activeTargets"]} == {"up"}, "the target")
        (group,) = stack.prometheus("rules")["groups"]
        assert {rule["health"] for rule in group["rules"]} <= {"ok", "unknown"}
        assert len(group["rules"]) == stack.run("cat", "/etc/prometheus/alerts.yml").count("- alert:")
        until(lambda: stack.prometheus("query?query=shmio_source_quality")["result"] != [], "a figure of the source")
        assert stack.prometheus("query?query=shmio_source_quality")["result"][0]["value"][1] == "2"
        assert stack.prometheus("alerts")["alerts"] == []
        ports = [one.split(":")[-1] for one in yaml.safe_load(COMPOSE.read_text())["services"]["cell"]["ports"]]
        for port in ports:
            stack.run("bash", "-c", f"exec 3<>/dev/tcp/cell/{port}")
        health = yaml.safe_load(COMPOSE.read_text())["services"]["cell"]["healthcheck"]["test"]
        assert "running" in stack.run(BIN / health[1], *health[2:])
