from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from shmio.endpoints.web.tabs import configuration
from shmio.segment import Segment
from tests.unit.endpoints.web.harness import processes, spec
from tests.unit.endpoints.web.tabs.test_injections import pushed
from tests.unit.endpoints.web.test_page import pages, said

TEXT = """[instance]
name = "a50"
[[source]]
name = "cell"
password = "hunter2-hunter2"
period_ms = -1
"""
DRY = ("stop", "start", "restart", "change", "injections", "reread", "keep")


class FakeSupervisor:
    """Answers requests at a control socket, and records them."""

    def __init__(self, path: Path) -> None:
        self.asked: list[dict[str, Any]] = []
        self.dry: dict[str, Any] = {"faults": [], "warnings": [], **{kind: [] for kind in DRY}, "keep": ["cell"]}
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            client, _ = self._listener.accept()
            with client:
                line = client.makefile().readline()
                if not line:
                    return
                asked = json.loads(line)
                self.asked.append(asked)
                client.sendall(json.dumps({"ok": True, **self._answer(asked)}).encode() + b"\n")

    def _answer(self, asked: dict[str, Any]) -> dict[str, Any]:
        if asked["do"] == "where":
            return {"read_ns": 1_000_000_000 * (1 + self.count("reload", dry=False))}
        if asked.get("dry_run"):
            return self.dry
        return {"done": ["cell: restarted"], "problems": [], "kept": [], "warnings": []}

    def count(self, do: str, *, dry: bool) -> int:
        return sum(one["do"] == do and one.get("dry_run", False) == dry for one in self.asked)

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(self._listener.getsockname())
        self._thread.join()
        self._listener.close()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "supervisor.toml"
    file.write_text(TEXT)
    return file


@contextmanager
def supervised(instance: str, folder: Path) -> Iterator[tuple[Segment, FakeSupervisor]]:
    control = folder / "control"
    supervisor = FakeSupervisor(control)
    try:
        with Segment.create(instance, [spec()], processes(), control=str(control)) as segment:
            yield segment, supervisor
            segment.unlink()
    finally:
        supervisor.close()


def test_file_is_masked_and_messages_are_at_their_lines(instance: str, tmp_path: Path, file: Path) -> None:
    with supervised(instance, tmp_path) as (segment, supervisor):
        faults = [
            f"{file}:6: source[0].period_ms: expected a number >= 0.1",
            f"{file}: the file is not valid TOML: Invalid value (at line 5, column 12): password = hunter2-hunter2",
            "/other/db201.db:3:1: error: wrong 'hunter2-hunter2'",
        ]
        supervisor.dry = {"faults": faults, "warnings": [f"{file}: warning: source[0].name: odd"]}
        with pages(segment, config_file=str(file)) as server, server.open() as browser:
            found = said(browser, "configuration.check")["result"]
    assert "hunter2" not in json.dumps(found)
    assert found["lines"][4] == 'password = "•••"'
    assert len(found["lines"]) == 6
    assert found["changes"] is None
    assert [(one["kind"], one["line"], one["text"]) for one in found["messages"]] == [
        ("fault", 6, "source[0].period_ms: expected a number >= 0.1"),
        ("fault", 5, "the file is not valid TOML: Invalid value (at line 5, column 12): password = •••"),
        ("fault", 0, "/other/db201.db:3:1: error: wrong '•••'"),
        ("warning", 4, "source[0].name: odd"),
    ]


def test_page_without_a_supervisor_shows_the_file_and_the_reason(segment: Segment, file: Path) -> None:
    with pages(segment, config_file=str(file)) as server, server.open() as browser:
        found = said(browser, "configuration.check")["result"]
        assert found["lines"][0] == "[instance]"
        assert "cannot be reached" in found["problem"]
        assert (found["changes"], found["read_s"]) == (None, None)
        file.unlink()
        assert "No such file" in said(browser, "configuration.check")["result"]["problem"]


def test_reload_needs_its_role_and_the_version_that_the_user_has_seen(
    instance: str, tmp_path: Path, file: Path
) -> None:
    with supervised(instance, tmp_path) as (segment, supervisor):
        others = ("read", "write", "inject")
        with pages(segment, roles=others, config_file=str(file)) as server, server.open() as browser:
            seen = said(browser, "configuration.check")["result"]["version"]
            assert "needs the role control" in said(browser, "configuration.reload", version=seen)["error"]
        with pages(segment, roles=("read", "control"), config_file=str(file)) as server, server.open() as browser:
            file.write_text(TEXT + "# more\n")
            assert "has changed since" in said(browser, "configuration.reload", version=seen)["error"]
            assert supervisor.count("reload", dry=False) == 0
            checks = supervisor.count("reload", dry=True)
            found = said(browser, "configuration.check")["result"]
            answer = said(browser, "configuration.reload", version=found["version"])["result"]
            assert answer == {"done": ["cell: restarted"], "problems": [], "kept": []}
            said(browser, "configuration.check")
            assert supervisor.count("reload", dry=True) == checks + 2, "nothing from before a reload is shown again"


def test_page_follows_the_file_and_pages_share_the_checks(
    instance: str, tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(configuration, "INTERVAL_S", 0.05)
    with supervised(instance, tmp_path) as (segment, supervisor), pages(segment, config_file=str(file)) as server:
        browsers = [server.open() for _ in range(8)]
        for browser in browsers:
            said(browser, "configuration.follow")
        for browser in browsers:
            assert pushed(browser, "configuration")["changes"]["keep"] == ["cell"]
        assert supervisor.count("reload", dry=True) < 4
        file.write_text(TEXT.replace("-1", "20"))
        assert pushed(browsers[0], "configuration")["lines"][5] == "period_ms = 20"
        assert said(browsers[0], "configuration.leave")["result"] is None
        for browser in browsers:
            browser.close()


def test_page_that_is_closed_leaves_its_request_to_the_others(instance: str, tmp_path: Path, file: Path) -> None:
    with supervised(instance, tmp_path) as (segment, supervisor), pages(segment, config_file=str(file)) as server:
        for _ in range(20):
            with server.open() as browser:
                browser.send(json.dumps({"id": 1, "call": "configuration.check"}))
        with server.open() as browser:
            assert said(browser, "configuration.check")["result"]["changes"]["keep"] == ["cell"]
        assert supervisor.count("reload", dry=True) <= 21
