"""The line in which ``up`` says what other users of this host may do to the instance."""

from __future__ import annotations

import os
import pwd
import sys
from pathlib import Path

import pytest

from shmio.cli.supervisor import main
from shmio.config import load
from shmio.plan.host import exposure, other_users

BASE = """
[instance]
name = "x"

[[source]]
name = "cell"
connector = "memory"
layout = "cell.toml"
period_ms = 20
writable = {writable}
"""
TOKEN = f'[[grpc.token]]\nname = "a"\nroles = ["read", "write"]\nsha256 = "{"0" * 64}"\n'
GRPC = '[grpc]\nlisten = ["127.0.0.1:8089", "[::1]:8090"]\n'
MQTT = '[mqtt]\nbroker = "embedded"\nlisten = "127.0.0.1:1883"\nprefix = "x"\n'
WEB = '[web]\nlisten = "127.0.0.1:8080"\n'
FABRIC = '[fabric]\nserver = "embedded"\n'
ALLOW = 'cell = "a.b.c"\n[[fabric.allow]]\nsender = "a.b.*"\nroles = ["read", "write", "inject"]\n'
FREE = '[[mqtt.account]]\nroles = ["read", "write"]\n'


def user(name: str, uid: int, shell: str = "/bin/bash") -> pwd.struct_passwd:
    return pwd.struct_passwd((name, "x", uid, uid, "", f"/home/{name}", shell))


def host_of(monkeypatch: pytest.MonkeyPatch, *users: pwd.struct_passwd) -> None:
    monkeypatch.setattr(pwd, "getpwall", lambda: list(users))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SHMIO_MOSQUITTO", sys.executable)  # any program will do
    Path("cell.toml").write_text('[registers]\nMode = "INT"\n')


@pytest.mark.parametrize(
    ("sections", "writable", "said"),
    [
        (GRPC, "[]", "ada) may write, inject and control by gRPC at 127.0.0.1:8089 and [::1]:8090 without logging in"),
        (GRPC + TOKEN, "[]", None),
        ('[grpc]\nlisten = ["unix:s"]\n', "[]", None),
        ('[[grpc.address]]\nlisten = "127.0.0.1:8089"\n', "[]", None),
        (
            '[[grpc.address]]\nlisten = "127.0.0.1:8089"\nroles = ["read", "write"]\n' + MQTT + FREE,
            '["**"]',
            "ada) may write by gRPC at 127.0.0.1:8089; and write by MQTT at 127.0.0.1:1883 without logging in",
        ),
        (WEB, "[]", "ada) may write, inject and control on the page at 127.0.0.1:8080 without logging in"),
        (WEB + 'roles = ["read"]\n', "[]", None),
        (WEB + GRPC + TOKEN, "[]", None),
        (MQTT + FREE, "[]", None),
        (MQTT, '["**"]', None),
        (MQTT + 'password_file = "accounts"\n', '["**"]', None),
        (FABRIC, "[]", None),
        (
            FABRIC + ALLOW,
            "[]",
            "may publish as the cells a.b.* and inject and write here by NATS at 127.0.0.1:4222 without logging in",
        ),
        (FABRIC + ALLOW + WEB, "[]", "prevent this (see SECURITY.md); for NATS, fabric.tls.ca"),
        ("", '["**"]', None),
    ],
)
def test_addresses_without_login_are_reported(
    sections: str, writable: str, said: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    host_of(monkeypatch, user("ada", 1001 + os.geteuid()))
    Path("accounts").write_text("a:b\n")
    Path("accounts").chmod(0o600)
    file = Path("supervisor.toml")
    file.write_text(BASE.format(writable=writable) + sections)
    line = exposure(load(file))
    assert (line is None) == (said is None)
    if line is not None:
        assert said is not None
        assert said in line


def test_check_notes_that_amqtt_lets_everybody_publish_values(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    host_of(monkeypatch, user("ada", 1001 + os.geteuid()))
    Path("supervisor.toml").write_text(BASE.format(writable="[]") + MQTT + FREE)
    assert main(["check"]) == 0
    assert "note: " not in capsys.readouterr().out
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    assert main(["check"]) == 0
    assert "ada) may publish everything, values too, by MQTT at 127.0.0.1:1883" in capsys.readouterr().out


def test_users_who_can_log_in(monkeypatch: pytest.MonkeyPatch) -> None:
    own = user("own", os.geteuid())
    system = user("postgres", 101), user("nobody", 65534), user("backup", 5000, "/usr/sbin/nologin"), user("root", 0)
    host_of(monkeypatch, own, *system)
    assert other_users() == []
    host_of(monkeypatch, own, *system, user("eve", 70_000), user("mallory", 70_001, "/bin/zsh"))
    assert other_users() == ["eve", "mallory"]


def test_check_notes_the_exposure_without_counting_it_as_a_fault(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    host_of(monkeypatch, *(user(name, 70_000) for name in ("a", "b", "c", "d", "e")))
    Path("supervisor.toml").write_text(BASE.format(writable="[]") + GRPC)
    assert main(["check"]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    [note] = [line for line in lines if "other users" in line]
    assert note.startswith("note: other users of this host (a, b, c and 2 more) may write, inject and control by gRPC")
    assert last == "no faults found"


@pytest.mark.parametrize(
    ("option", "roles"), [([], ["read"]), (["--emulated"], ["read", "write", "inject", "control"])]
)
def test_init_writes_the_roles_of_each_address(option: list[str], roles: list[str]) -> None:
    Path("cell.db").write_text("DATA_BLOCK DB7\nSTRUCT\nx : Int;\nEND_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n")
    assert main(["init", *option, "cell.db"]) == 0
    grpc = load(Path("supervisor.toml")).grpc
    assert grpc is not None
    assert [address.roles for address in grpc.listening.values()] == [roles, roles]
