"""``[mqtt]``: defaults, the address of the broker, accounts, and errors."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path

import pytest

from shmio.config import Mqtt, MqttAccount, load
from shmio.config.credentials import hashed, read_accounts, read_password
from shmio.config.mqtt import brokers
from shmio.errors import ConfigError

OWN = '[mqtt]\nlisten = "127.0.0.1:1883"\n'
EXTERNAL = '[mqtt]\nbroker = "external"\n'
ACCOUNT = "[[mqtt.account]]\nroles = "
TLS = '[mqtt.tls]\nca = "ca.pem"\n'


def read(folder: Path, text: str) -> Mqtt:
    file = folder / "supervisor.toml"
    file.write_text(f'[instance]\nname = "a"\n{text}')
    mqtt = load(file).mqtt
    assert mqtt is not None
    return mqtt


def test_missing_keys_have_defaults(tmp_path: Path) -> None:
    mqtt = read(tmp_path, OWN)
    assert (mqtt.broker, mqtt.prefix, mqtt.keep_alive_s, mqtt.session_expiry_s) == ("embedded", "shmio/a", 30, 0)
    assert mqtt.password_file is None


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    mqtt = read(tmp_path, f'{EXTERNAL}host = "b"\nusername = "u"\npassword_file = "p"\n{TLS}')
    assert mqtt.password_file == str(tmp_path / "p")
    assert mqtt.tls is not None
    assert mqtt.tls.ca == str(tmp_path / "ca.pem")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('host = "127.0.0.1"', ["127.0.0.1:1883"]),
        ('host = "127.0.0.1:99"', ["127.0.0.1:99"]),
        ('host = ["b1", "b2:9"]\nport = 7\ninsecure = true', ["b1:7", "b2:9"]),
        (f'host = "b1"\n{TLS}', ["b1:8883"]),
        ('host = "[::1]"', ["[::1]:1883"]),
        ('host = "[::1]:9"', ["[::1]:9"]),
    ],
)
def test_address_of_an_external_broker(tmp_path: Path, text: str, expected: list[str]) -> None:
    assert [str(address) for address in brokers(read(tmp_path, f"{EXTERNAL}{text}\n"))] == expected


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[mqtt]\n", "mqtt.listen: this key is needed"),
        ('[mqtt]\nlisten = "1883"\n', "mqtt.listen: '1883' is not an address"),
        ('[mqtt]\nlisten = "127.0.0.1:0"\n', "mqtt.listen: 127.0.0.1:0 has no port"),
        ('[mqtt]\nlisten = "0.0.0.0:1883"\n', "other hosts can reach 0.0.0.0:1883 in plain text"),
        ('[mqtt]\nlisten = "0.0.0.0:1883"\n[mqtt.tls]\nca = "x"\n', "mqtt.tls.certificate: this key is needed"),
        (f'{OWN}host = "b"\n', 'mqtt.host: this key is only for broker = "external"'),
        (f'{OWN}username = "b"\n', "mqtt.username: this key is only for"),
        (f'{OWN}prefix = "a/#"\n', "mqtt.prefix: a topic cannot begin with 'a/#'"),
        (f'{OWN}prefix = "$SYS"\n', "mqtt.prefix"),
        (f'{OWN}prefix = "a/"\n', "mqtt.prefix"),
        (f'{OWN}prefix = "a//b"\n', "mqtt.prefix: a topic cannot begin with 'a//b'"),
        (f'{OWN}prefix = "a\\u0000"\n', "mqtt.prefix: must not contain control characters"),
        (f'{OWN}prefix = "a\\u009f"\n', r"mqtt.prefix: a topic cannot begin with 'a\x9f'"),
        (f'{OWN}prefix = "a\\uffff"\n', r"mqtt.prefix: a topic cannot begin with 'a\uffff'"),
        (f'{OWN}prefix = "{"a" * 257}"\n', "write at most 256 characters"),
        (f'{OWN}client_id = "a\\u0000"\n', "mqtt.client_id: must not contain control characters"),
        (f'{OWN}[mqtt.sparkplug]\ngroup = "a/b"\n', "mqtt.sparkplug.group: 'a/b' cannot be a part of a topic"),
        (f'{OWN}[mqtt.sparkplug]\ngroup = "a"\nnode = "+"\n', "mqtt.sparkplug.node: '+' cannot be a part of a topic"),
        (f'{OWN}[mqtt.sparkplug]\ngroup = "a\\n"\n', "mqtt.sparkplug.group: must not contain control characters"),
        (f'{OWN}[mqtt.sparkplug]\ngroup = "\\ufdd0"\n', r"mqtt.sparkplug.group: '\ufdd0' cannot be a part of a topic"),
        (
            f'{OWN}[mqtt.sparkplug]\ngroup = "a"\nnode = "{"n" * 257}"\n',
            "cannot be a part of a topic; write at most 256 characters",
        ),
        (
            f'{OWN}[mqtt.sparkplug]\ngroup = "a"\nprimary_host = "a/b"\n',
            "mqtt.sparkplug.primary_host: 'a/b' cannot be a part",
        ),
        (f'{OWN}[mqtt.sparkplug]\ngroup = "a"\nnode = ""\n', "mqtt.sparkplug.node: must not be empty"),
        (f"{OWN}[mqtt.sparkplug]\n", "mqtt.sparkplug.group"),
        (f'{OWN}broker = "hive"\n', "mqtt.broker: unknown broker 'hive'; valid: embedded, mosquitto, external"),
        (f"{OWN}backlog = 1\n", "mqtt.backlog: unknown key; did you mean 'backlog_mb'?"),
        (f'{OWN}[mqtt.topic]\nmatch = "a"\n', "mqtt.topic: write [[mqtt.topic]]"),
        (f"{OWN}[[mqtt.topic]]\n", "mqtt.topic[0].match: this key is needed"),
        (f'{OWN}[[mqtt.topic]]\nmatch = "a"\nqos = 2\n', "mqtt.topic[0].qos"),
        (f'{OWN}[[mqtt.topic]]\nmatch = "a"\nretained = true\n', "unknown key; did you mean 'retain'?"),
        (f'{OWN}[[mqtt.topic]]\nmatch = "a"\npayload = "xml"\n', "valid: text, json, structure, frames"),
        (
            f'{OWN}[[mqtt.topic]]\nmatch = "a"\npayload = "structure"\ndeadband = 1\n',
            "mqtt.topic[0].deadband: this key is only for single",
        ),
        (
            f'{OWN}[[mqtt.topic]]\nmatch = "a"\npayload = "frames"\nelements = true\n',
            "mqtt.topic[0].elements: this key is only for",
        ),
        (f'{OWN}[mqtt.account]\nroles = ["read"]\n', "mqtt.account: write [[mqtt.account]]"),
        (f"{OWN}[[mqtt.account]]\n", "mqtt.account[0].roles: this key is needed"),
        (f'{OWN}{ACCOUNT}["see"]\n', "mqtt.account[0].roles[0]: unknown role 'see'; valid: read, write"),
        (f'{OWN}{ACCOUNT}["read"]\n{ACCOUNT}["write"]\n', "mqtt.account[1].name: mqtt.account[0] has no name either"),
        (f'{OWN}{ACCOUNT}["read"]\nname = "a"\n', "mqtt.account[0].name: 'a' needs a password"),
        (f'{OWN}{ACCOUNT}["read"]\npublish = ["a"]\n', "mqtt.account[0].publish: this key needs the role write"),
        (
            f'{OWN}{ACCOUNT}["write"]\npublish = ["a/#/b"]\n',
            "mqtt.account[0].publish[0]: 'a/#/b' is not a topic filter",
        ),
        (f'{OWN}{ACCOUNT}["write"]\npublish = ["$SYS/#"]\n', "publish[0]: '$SYS/#' is not a topic filter"),
        (f'{OWN}{ACCOUNT}["write"]\npublish = ["b", "+/#"]\n', "publish[1]: '+/#' would let others publish on"),
        (f'{OWN}{ACCOUNT}["write"]\npublish = ["shmio/a"]\n', "the instance's own topics, such as shmio/a/#"),
        (f'{OWN}{ACCOUNT}["write"]\npublish = ["shmio/+/x"]\n', "the instance's own topics, such as shmio/a/#"),
        (
            f'{OWN}{ACCOUNT}["write"]\npublish = ["spBv1.0/g/DDATA/#"]\n[mqtt.sparkplug]\ngroup = "g"\n',
            "the instance's own topics, such as spBv1.0/g/+/a/#",
        ),
        (f'{EXTERNAL}host = "127.0.0.1"\n{ACCOUNT}["read"]\n', "an external broker has accounts of its own"),
        (EXTERNAL, 'mqtt.host: this key is needed with broker = "external"'),
        (f'{EXTERNAL}host = "b"\n', "shmio would send plain text over the network to b:1883"),
        (f'{EXTERNAL}host = ["b", "c:x"]\n{TLS}', "mqtt.host[1]"),
        (f'{EXTERNAL}host = "mqtts://b:8883"\n{TLS}', "mqtt.host: 'mqtts://b:8883': write the host's name or address"),
        (
            f'{EXTERNAL}host = "b"\nlisten = "127.0.0.1:1"\n{TLS}',
            "mqtt.listen: shmio does not start an external broker",
        ),
        (f'{EXTERNAL}host = "b"\npassword_file = "p"\n{TLS}', "mqtt.username: this key is needed"),
        (f'{EXTERNAL}host = "b"\n{TLS}key = "k"\n', "mqtt.tls: give both certificate and key"),
        (f'{OWN}[[source]]\nname = "broker"\nconnector = "memory"\n', "is the name of one of shmio's processes"),
    ],
)
def test_fault_is_named_by_its_key(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, text)
    assert told in str(caught.value)


def test_accounts_may_publish_on_topics_outside_the_instance(tmp_path: Path) -> None:
    topics = ["shmio/b/#", "shmio", "homeassistant/+/x", "spBv1.0/g/+/b/#"]
    mqtt = read(tmp_path, f'{OWN}{ACCOUNT}["write"]\npublish = {topics}\n[mqtt.sparkplug]\ngroup = "g"\n')
    assert mqtt.account[0].publish == topics


def test_account_with_roles_needs_a_password(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"mqtt\.account\[1\]\.name: .* has no password for 'bert'"):
        read_accounts(secret(tmp_path, "anna:x\n"), [MqttAccount(roles=["read"], name=one) for one in ("anna", "bert")])


def secret(folder: Path, text: str, mode: int = 0o600) -> str:
    file = folder / "secret"
    file.write_text(text)
    file.chmod(mode)
    return str(file)


def test_accounts_are_hashed_as_mosquitto_does(tmp_path: Path) -> None:
    known = hashed("it is:me")
    accounts = read_accounts(secret(tmp_path, f"# of the line\nanna:se:cret\n\nbert:{known}\n"))
    assert accounts["bert"] == known
    for name, password in (("anna", "se:cret"), ("bert", "it is:me")):
        _, kind, rounds, salt, digest = accounts[name].split("$")
        assert kind == "7"
        found = hashlib.pbkdf2_hmac("sha512", password.encode(), base64.b64decode(salt), int(rounds))
        assert base64.b64encode(found).decode() == digest


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("anna\n", "line 1: expected name:password"),
        ("a:x\na:y\n", "line 2: this name is given twice"),
        ("# none\n", "the file has no account"),
        (":x\n", "line 1: expected name:password"),
        ("anna: secret\n", "line 1: remove the blanks next to the colon"),
        ("a:x\nanna :secret\n", "line 2: remove the blanks next to the colon"),
        ("anna:$argon2id$v=19$m=65536,t=3,p=1$c2FsdA$aGFzaA\n", "line 1: the hash is damaged"),
        ("anna:$7$101$c2Fs*A==$aGFzaA==\n", "make one with mosquitto_passwd -H sha512-pbkdf2"),
    ],
)
def test_invalid_account_is_refused_and_not_shown(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_accounts(secret(tmp_path, text))
    assert told in str(caught.value)


def test_password_is_the_first_line_of_a_private_file(tmp_path: Path) -> None:
    assert read_password(secret(tmp_path, "se cret\r\nand more\n")) == "se cret"
    for text, mode, told in (("x\n", 0o644, "chmod 600"), ("\n", 0o600, "is empty")):
        with pytest.raises(ConfigError, match=told):
            read_password(secret(tmp_path, text, mode))
    with pytest.raises(ConfigError, match=r"mqtt\.password_file: .*No such file"):
        read_password(str(tmp_path / "none"))
