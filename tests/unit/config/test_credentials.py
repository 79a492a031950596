"""Tokens: read only from private files, and never shown."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from shmio.config import Token
from shmio.config.credentials import read_tokens
from shmio.errors import ConfigError

SECRET = "0123456789abcdef0123456789abcdef"


def token(file: Path | None = None, sha256: str | None = None, name: str = "dash") -> Token:
    return Token(name=name, roles=["read"], token_file=None if file is None else str(file), sha256=sha256)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "token"
    file.write_text(SECRET + "\n")
    file.chmod(0o600)
    return file


def test_file_and_hash_give_the_same_token(file: Path) -> None:
    expected = hashlib.sha256(SECRET.encode()).hexdigest()
    (one,), (other,) = read_tokens([token(file)]), read_tokens([token(sha256=expected)])
    assert one == other
    assert SECRET not in repr(one)
    with pytest.raises(ConfigError, match=r"grpc\.token\[1\]: this is the same token as that of 'dash'"):
        read_tokens([token(file), token(sha256=expected, name="other")])


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644, 0o620])
def test_file_that_other_users_can_access_is_refused(file: Path, mode: int) -> None:
    file.chmod(mode)
    with pytest.raises(ConfigError, match=rf"token_file: .*its mode is {mode:04o}; run chmod 600, and use a new token"):
        read_tokens([token(file)])


@pytest.mark.parametrize(
    "content", [b"", b"short", b"a" * 1025, b"a b" * 10, SECRET.encode() * 2 + b"\nanother\n", b"\xff" * 32, b"\0" * 32]
)
def test_invalid_token_is_refused_and_not_shown(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=r"grpc\.token\[0\]\.token_file: .*openssl rand -hex 32") as caught:
        read_tokens([token(file)])
    assert SECRET not in str(caught.value)


def test_path_without_a_regular_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name, why in (("none", "No such file"), ("pipe", "not a regular file"), (".", "not a regular file")):
        with pytest.raises(ConfigError, match=rf"token_file: .*: .*{why}"):
            read_tokens([token(tmp_path / name)])
