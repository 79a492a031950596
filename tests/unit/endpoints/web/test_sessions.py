from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from shmio.config.credentials import Secret, digest
from shmio.endpoints.web import __main__ as web
from shmio.endpoints.web import sessions
from shmio.endpoints.web.sessions import Sessions

TOKEN = "a-token-of-thirty-two-characters"
SECRETS = (Secret("ann", frozenset({"read", "write"}), digest(TOKEN.encode())),)


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_token_opens_a_session_that_ends() -> None:
    clock = Clock()
    users = Sessions(SECRETS, ["read"], clock)
    opened = users.open(f"{TOKEN}\n", "10.0.0.1")
    assert opened is not None
    cookie, user = opened
    assert (user.name, user.listed_roles) == ("ann", ["read", "write"])
    assert users.user(cookie, "10.0.0.1") == user
    clock.now_s = sessions.MAX_AGE_S - 1
    assert users.user(cookie, "10.0.0.1") == user
    clock.now_s += 1
    assert users.user(cookie, "10.0.0.1").name == ""
    assert users.user(None, "10.0.0.1").listed_roles == ["read"]


def test_stolen_cookie_is_worth_nothing_elsewhere() -> None:
    users = Sessions(SECRETS, [])
    opened = users.open(TOKEN, "10.0.0.1")
    assert opened is not None
    assert users.user(opened[0], "10.0.0.2").roles == frozenset()
    users.close(opened[0])
    assert users.user(opened[0], "10.0.0.1").roles == frozenset()


def test_number_of_sessions_is_bounded() -> None:
    users = Sessions(SECRETS, [])
    opened = [users.open(TOKEN, "10.0.0.1") for _ in range(sessions.MAX_SESSIONS + 1)]
    names = [users.user(one[0], "10.0.0.1").name for one in opened if one is not None]
    assert names == ["", *["ann"] * sessions.MAX_SESSIONS]


def test_user_with_many_sessions_signs_nobody_else_out() -> None:
    users = Sessions((*SECRETS, Secret("bob", frozenset({"read"}), digest(b"bobs"))), [])
    first = users.open("bobs", "10.0.0.1")
    many = [users.open(TOKEN, "10.0.0.2") for _ in range(sessions.MAX_SESSIONS)]
    assert first is not None
    assert users.user(first[0], "10.0.0.1").name == "bob"
    assert many[0] is not None
    assert users.user(many[0][0], "10.0.0.2").name == ""


def test_reload_reads_the_tokens_again_and_ends_the_sessions_of_those_that_are_gone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    old, new, kept = "old-0123456789abcdefghijk", "new-0123456789abcdefghijk", "kept-0123456789abcdefghijk"
    files = {name: tmp_path / name for name in ("ann", "bob")}
    for file, token in ((files["ann"], old), (files["bob"], kept)):
        file.write_text(token)
        file.chmod(0o600)
    config = tmp_path / "supervisor.toml"
    tokens = "".join(f'[[grpc.token]]\nname = "{one}"\nroles = ["read"]\ntoken_file = "{one}"\n' for one in files)
    listen = 'listen = ["127.0.0.1:0"]'
    config.write_text(f'[instance]\nname = "x"\n[grpc]\n{listen}\n{tokens}[metrics]\nlisten = "127.0.0.1:1"\n')
    metrics = cast("Any", SimpleNamespace(name="metrics", log=logging.getLogger("test")))
    users, ended = Sessions((), []), list[str]()
    web._take_anew(metrics, config, users)
    first, second = users.open(old, "h"), users.open(kept, "h")
    assert first is not None
    assert second is not None
    users.on_end(first[0], "h", lambda: ended.append("first"))
    files["ann"].write_text(new)
    web._take_anew(metrics, config, users)
    assert ended == ["first"]
    assert [users.user(one[0], "h").name for one in (first, second)] == ["", "bob"]
    assert [users.owner(one, "h") is not None for one in (old, new, kept)] == [False, True, True]
    files["bob"].unlink()
    web._take_anew(metrics, config, users)
    assert "keeps its tokens as they were" in caplog.text
    assert users.owner(new, "h") is not None
