"""Addresses, tokens and roles of ``[grpc]``: the roles that each address gives, and errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.config import Grpc, UnixAddress, load, parse_address
from shmio.config.listening import encrypted, takes_tokens
from shmio.errors import ConfigError

TLS = '[grpc.tls]\ncertificate = "c.pem"\nkey = "k.pem"\n'
MUTUAL = f'{TLS}client_ca = "ca.pem"\n'
TOKEN = '[[grpc.token]]\nname = "dash"\nroles = ["read"]\ntoken_file = "dash.token"\n'
CLIENT = '[[grpc.client]]\nsubject = "*.lab"\nroles = ["read", "write"]\n'
OLD = '[[grpc.address]]\nlisten = "10.0.0.5:8089"\n'
ALL = {"read", "write", "inject", "control"}


def read(folder: Path, text: str) -> Grpc:
    file = folder / "supervisor.toml"
    file.write_text(f'[instance]\nname = "a"\n{text}')
    grpc = load(file).grpc
    assert grpc is not None
    return grpc


def served(grpc: Grpc) -> list[tuple[set[str], bool, bool]]:
    """Return (roles without credentials, encrypted, accepts tokens) for each address."""
    return [(set(at.roles), encrypted(grpc, at), takes_tokens(grpc, at)) for at in grpc.listening.values()]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('[grpc]\nlisten = ["127.0.0.1:1", "unix:s"]\n', [(ALL, False, True)] * 2),
        ('[grpc]\nlisten = ["10.0.0.5:1"]\ninsecure = true\n', [(ALL, False, False)]),
        (f'[grpc]\nlisten = ["10.0.0.5:1", "unix:s"]\n{TLS}', [(ALL, True, True), (ALL, False, True)]),
        (f'[grpc]\nlisten = ["127.0.0.1:1", "unix:s"]\n{TOKEN}', [(set(), False, True)] * 2),
        (f'[grpc]\nlisten = ["10.0.0.5:1"]\n{MUTUAL}{CLIENT}', [(set(), True, True)]),
        (
            f'[grpc]\nlisten = ["10.0.0.5:1"]\ninsecure = true\ntokens_in_plain_text = true\n{TOKEN}',
            [(set(), False, True)],
        ),
        (
            f'[grpc]\nlisten = ["10.0.0.5:1"]\n{TLS}{TOKEN}{OLD}insecure = true\n',
            [(set(), True, True), ({"read"}, False, False)],
        ),
        (f'[grpc]\nlisten = ["127.0.0.1:1"]\n{TLS}{OLD}', [(ALL, True, True), ({"read"}, True, True)]),
        (
            f'[grpc]\n{TLS}{TOKEN}[[grpc.address]]\nlisten = "unix:s"\nroles = ["read", "control"]\n',
            [({"read", "control"}, False, True)],
        ),
    ],
)
def test_roles_of_each_address(tmp_path: Path, text: str, expected: list[tuple[set[str], bool, bool]]) -> None:
    assert served(read(tmp_path, text)) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[grpc]\n", r"grpc\.listen: this key is needed"),
        ('[grpc]\nlisten = ["unix:"]\n', r"grpc\.listen\[0\]: 'unix:' is not a UNIX socket"),
        (
            f'[grpc]\nlisten = ["unix:{"x" * 120}"]\n',
            r"grpc\.listen\[0\]: unix:x*: the path of a UNIX socket has at most 107",
        ),
        (f'[grpc]\nlisten = ["10.0.0.5:1"]\n{OLD}', r"grpc\.listen\[0\]: .*plain text; add a \[grpc\.tls\]"),
        (f'[grpc]\nlisten = ["127.0.0.1:1"]\n{OLD}', r"grpc\.address\[0\]\.listen: .*plain text; add a \[grpc\.tls\]"),
        (
            f'[grpc]\nlisten = ["10.0.0.5:1"]\ninsecure = true\n{TOKEN}',
            r"grpc\.listen\[0\]: .*tokens of \[\[grpc\.token\]\].*tokens_in_plain_text = true",
        ),
        (
            f'[grpc]\nlisten = ["10.0.0.5:1", "unix:s"]\n{MUTUAL}{CLIENT}',
            r"grpc\.listen\[1\]: unix:.*uses no certificates",
        ),
        (f'[grpc]\nlisten = ["127.0.0.1:1"]\n{TLS}{CLIENT}', r"grpc\.client: .*client_ca in \[grpc\.tls\]"),
        (
            f'[grpc]\nlisten = ["127.0.0.1:1"]\n{TOKEN.replace("read", "reed")}',
            r"grpc\.token\[0\]\.roles\[0\]: unknown role 'reed'; did you mean 'read'\?",
        ),
        (
            f'[grpc]\nlisten = ["127.0.0.1:1"]\n{OLD}insecure = true\nroles = ["admin"]\n',
            r"grpc\.address\[0\]\.roles\[0\]: unknown role 'admin'; valid: read, write, inject, control",
        ),
        (
            f'[grpc]\nlisten = ["127.0.0.1:1"]\n{OLD}insecure = true\nroles = []\n',
            r"grpc\.address\[0\]\.roles: must not be empty",
        ),
        (f'[grpc]\nlisten = ["127.0.0.1:1"]\n{TOKEN}{TOKEN}', r"grpc\.token\[1\]\.name: 'dash' is already"),
        (f'[grpc]\nlisten = ["127.0.0.1:1"]\n{TOKEN}sha256 = "00"\n', r"grpc\.token\[0\]: give either token_file"),
        (
            '[grpc]\nlisten = ["127.0.0.1:1"]\n[[grpc.token]]\nname = "a"\nroles = ["read"]\n',
            r"grpc\.token\[0\]: give either token_file",
        ),
        (
            '[grpc]\nlisten = ["127.0.0.1:1"]\n[[grpc.token]]\nname = "a"\nroles = ["read"]\nsha256 = "hunter2"\n',
            r"grpc\.token\[0\]\.sha256: expected 64 hexadecimal digits",
        ),
        ('[grpc]\nlisten = ["127.0.0.1:1"]\n[grpc.token]\nname = "a"\n', r"grpc\.token: write \[\[grpc\.token\]\]"),
        (
            '[grpc]\nlisten = ["127.0.0.1:1"]\n[[grpc.token]]\nname = "a"\nroles = ["read"]\ntoken = "hunter2"\n',
            r"grpc\.token\[0\]\.token: unknown key; did you mean 'token_file'\?",
        ),
    ],
)
def test_fault_is_named_by_its_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        read(tmp_path, text)
    assert "hunter2" not in str(caught.value)


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    grpc = read(tmp_path, f'[grpc]\nlisten = ["unix:run/s", "unix:///abs/s"]\n{TOKEN}')
    assert grpc.listen == [f"unix:{tmp_path}/run/s", "unix:/abs/s"]
    assert grpc.token[0].token_file == f"{tmp_path}/dash.token"
    assert parse_address(grpc.listen[1]) == UnixAddress("/abs/s")


def test_long_folder_name_makes_a_socket_path_too_long(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    with pytest.raises(ConfigError, match=r"grpc\.listen\[0\]: unix:.*has at most 107 bytes"):
        read(folder, '[grpc]\nlisten = ["unix:s"]\n')
