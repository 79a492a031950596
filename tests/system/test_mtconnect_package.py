"""The package of the connector mtconnect installs, is found by its entry point, and passes its tests."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shmio.testing.cell import until
from shmio.testing.ports import reserved_port
from tests.system.plugin import Environment

PACKAGE = Path(__file__).parents[2] / "examples" / "mtconnect"
SUPERVISOR = ("-m", "shmio.cli.supervisor")
USER = ("-c", "import sys; from shmio.cli.user import main; sys.exit(main())")


@contextmanager
def agent() -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Run the agent of the package's tests; yield its port and the process."""
    command = ["node", str(PACKAGE / "tests" / "agent.js")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip(), process
        process.communicate(timeout=60)


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_package_works_where_it_is_installed(tmp_path: Path, instance: str) -> None:
    environment = Environment(tmp_path / "environment", PACKAGE)
    checked = json.loads(environment.run(*SUPERVISOR, "check", "--json"))
    assert "http://127.0.0.1:5000" in checked["sources"][0].values()
    tests = environment.run("-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "2")
    assert " passed" in tests
    assert "failed" not in tests

    config = environment.package / "supervisor.toml"
    with agent() as (port, process), reserved_port() as grpc:
        text = config.read_text().replace("127.0.0.1:5000", f"127.0.0.1:{port}")
        config.write_text(text.replace("mtconnect-example", instance).replace("127.0.0.1:8089", str(grpc)))
        environment.run(*SUPERVISOR, "up", "--detach")
        try:
            assert process.stdin is not None
            process.stdin.write(json.dumps({"set": {"Xact": "12.5", "exec": "ACTIVE"}}) + "\n")
            process.stdin.flush()

            def shown() -> dict[str, object]:
                found = json.loads(environment.run(*USER, "get", "--json", "cnc"))
                return {path: one["value"] for path, one in found.items() if one["quality"] == "good"}

            expected = {"cnc/X/Position": 12.5, "cnc/Path/Running": True, "cnc/Path/Execution": "ACTIVE"}
            until(lambda: shown() == expected, "the values of the agent, and no others")
        finally:
            environment.run(*SUPERVISOR, "down")
