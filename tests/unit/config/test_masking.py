from __future__ import annotations

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.config.masking import MASK, is_secret, mask, mask_value

SECRET = "hunter2-hunter2"


@pytest.mark.parametrize(
    "text",
    [
        f'password = "{SECRET}"',
        f"password = '{SECRET}'",
        f'password = """\nabc\n{SECRET}\n"""',
        f'"pass" = "{SECRET}"',
        f'apiKey = "{SECRET}"',
        f'api_key = ["a", "{SECRET}"]',
        f'key = "{SECRET}"',
        f'broker.auth.user = "{SECRET}"',
        f'auth = {{ user = "{SECRET}", host = "a" }}',
        f'options = {{ host = "a", token = "{SECRET}" }}',
        f'[source.credentials]\nuser = "{SECRET}"',
        f'[[grpc.token]]\nname = "ann"\nsha256 = "{SECRET}"',
        f'url = "opc.tcp://me:{SECRET}@host:4840/x"',
        f'url = "https://{SECRET}@host"',
        f'host = "me:{SECRET}@host"',
        f'command = "run --password={SECRET}"',
        f'[[alert]]\nwebhook = "https://hooks.example/{SECRET}"',
        f'command = ["curl", "-H", "Authorization: Bearer {SECRET}"]',
        f'command = ["mosquitto_pub", "--password", "{SECRET}", "-t", "alarm"]',
        f'command = [\n"mail",\n"--api-key",  # of the provider\n"{SECRET}"]',
        f'command = "notify --token {SECRET}"',
        f'headers = ["Bearer {SECRET}"]',
        f'url = "https://host/hook?channel=7&access_token={SECRET}"',
        f'url = "https://hooks.example/services/T0123/{SECRET}aB3dE6gH9"',
        f'url = "https://host/x" # Basic {SECRET}',
        f'text = "ghp_0123456789abcdefABCD {SECRET[:0]}" # password: {SECRET}',
        f"# password = {SECRET}",
        f'listen = ["a"] # the token: "{SECRET}"',
        f'text = """\npassword = "{SECRET}"\n"""',
        # Not TOML:
        f"password = {SECRET}",
        f'password = "{SECRET}',
        f"password: {SECRET}",
        f"password:{SECRET}",
        f'listen = ["a"\npassword = "{SECRET}"',
        f'text = """\npassword = "{SECRET}"',
        f'host = "abc\npassword = "{SECRET}"',
        f'password =\n"{SECRET}"',
        f'password = [\n"a",\n"{SECRET}"',
    ],
)
def test_secret_is_masked(text: str) -> None:
    masked = mask(f'[instance]\nname = "a50"\n{text}\n\n[web]\nlisten = "127.0.0.1:0"\n')
    assert SECRET not in masked.text
    assert MASK in masked.text
    assert '[instance]\nname = "a50"' in masked.text


@pytest.mark.parametrize(
    "text",
    [
        '[grpc.tls]\ncertificate = "server.pem"\nkey = "server.key"\n',
        '[[grpc.token]]\nname = "ann"\nroles = ["read"]\ntoken_file = "ann.token"\n',
        '[mqtt]\nusername = "shmio"\npassword_file = "/run/secrets/mqtt" # a file\n',
        "[grpc]\ntokens_in_plain_text = true\n",
        '[[alert]]\nwebhook_timeout_s = 5\nwebhook_header_file = "header"\n',
        '[[injection]]\nwhen = "cell/token == 3"\n',
        'writable = ["Outputs", "Robot_*/*"]\nperiod_ms = 20.5\n',
        '[[source]]\nurl = "opc.tcp://10.0.0.1:4840"\n',
        'when = "cell/a:b"\nmail = "ops@plant.example"\n',
        '[[source]]\nurl = "http://10.0.0.1:5000/machines/DMG-Mori-NLX2500-line-3/sample"\n',
        'command = ["logger", "-p", "user.err", "--tag", "shmio"]\n',
        'command = ["mosquitto_pub", "--password-file", "mqtt.secret"]\n',
        "# the bearer is at the door, and a basic rule holds\n",
    ],
)
def test_other_text_is_shown(text: str) -> None:
    assert mask(text).text == text


def test_file_stays_toml_with_the_same_lines() -> None:
    text = f'password = """\na\n{SECRET}"""\n[web]\npin = "1234"\nlisten = "a"\n'
    masked = mask(text).text
    assert masked.count("\n") == text.count("\n")
    assert tomllib.loads(masked) == {"password": MASK, "web": {"pin": MASK, "listen": "a"}}


def test_messages_that_quote_the_file_are_masked() -> None:
    masked = mask(f"password = {SECRET}\npwd = 'other secret'\n")
    message = (
        f"a.toml: the file is not valid TOML: Invalid value (at line 1, column 12): password = {SECRET}; write "
        f'"{SECRET}"'
    )
    assert (
        masked.hide(message)
        == f"a.toml: the file is not valid TOML: Invalid value (at line 1, column 12): password = {MASK}"
    )
    assert masked.hide("source[0].x: 'other secret' is unknown") == f"source[0].x: '{MASK}' is unknown"
    about = "a.toml:3: grpc.token[0].sha256: expected 64 hexadecimal digits"
    assert masked.hide(about) == about


def test_values_are_masked_by_their_keys() -> None:
    assert mask_value("writable", []) == []
    given = {"url": "mqtt://u:p@h", "options": {"api_key": 5, "host": "h"}, "key": "a.pem", "token": [{"name": "n"}]}
    assert mask_value("", given) == {
        "url": f"mqtt://{MASK}@h",
        "options": {"api_key": MASK, "host": "h"},
        "key": "a.pem",
        "token": [MASK],
    }
    assert not is_secret("tokens_in_plain_text")


@given(st.text(alphabet="\"'#[]{}=.,:\n\\ abpassword0-"))
def test_any_text_keeps_its_lines(text: str) -> None:
    assert mask(text).text.count("\n") == text.count("\n")


@pytest.mark.parametrize(
    "text",
    [
        "ghp_0123456789abcdefABCDEFGH",
        "xoxb-12345-67890-abcdef",
        "AKIA0123456789ABCDEF",
        "eyJhbGciOiJIUzI1NiJ9.eyJzdWIiOiIxMjM0In0.c2lnbmF0dXJl",
        "https://discord.example/api/webhooks/1234/a1B2c3D4e5F6g7H8i9J0k1",
    ],
)
def test_tokens_are_known_by_their_form(text: str) -> None:
    shown = mask(f'anything = "{text}"\n').text
    assert MASK in shown
    assert text.rpartition("/")[2] not in shown
    assert mask_value("anything", [text])[0] == shown.split('"')[1]


def test_parsed_value_after_an_option_is_masked() -> None:
    assert mask_value("command", ["x", "--password", SECRET, "y"]) == ["x", "--password", MASK, "y"]
