"""All faults of a configuration are reported together, with their lines.

A hostile file causes a bounded number of lines.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from shmio.config import load
from shmio.config.faults import Faults, Lines
from shmio.errors import ConfigError
from shmio.plan.prepare import prepare

HEAD = '[instance]\nname = "x"\n'
MANY = """[instance]
name = "a50"
clock = "Wall"
ring = 3

[[source]]
name = "cell"
layout = 5
period_ms = "x"

[[source]]
name = "Model"
connector = "memory"
stale_ms = 1

[[emulator]]
name = "model"
kind = "s7"
listen = "1102"
layout = "x.db"

[grpc]
listen = [
    "0.0.0.0:1",
]
[[grpc.token]]
name = "x"
roles = ["Read"]

[[injection]]
name = "drift"
target = "cell/a"
operation = "offset"

[[injection]]
name = "drift"
target = "cell/a"
operation = "ofset"
"""


def refused(folder: Path, text: str) -> list[str]:
    file = folder / "supervisor.toml"
    file.write_text(text, newline="")
    with pytest.raises(ConfigError) as caught:
        load(file)
    return [line.replace(str(file), "F") for line in str(caught.value).split("\n")]


def test_all_faults_are_reported_together_with_their_lines(tmp_path: Path) -> None:
    assert refused(tmp_path, MANY) == [
        "F:3: instance.clock: unknown clock 'Wall'; did you mean 'wall'?",
        "F:4: instance.ring: unknown key; did you mean 'ring_mb'?",
        'F:6: source[0].connector: this key is needed (source "cell")',
        'F:8: source[0].layout: expected text or a list in [ ], found 5 (source "cell")',
        "F:9: source[0].period_ms: expected a number, found 'x' (source \"cell\")",
        "F:12: source[1].name: 'Model' is reserved; choose another name",
        (
            "F:14: source[1].stale_ms: 1 is less than two periods of 20 ms: one late frame would make the source "
            "bad; raise stale_ms "
            '(source "Model")'
        ),
        "F:17: emulator[0].name: 'model' is reserved; choose another name",
        (
            "F:19: emulator[0].listen: '1102' is not an address; expected host:port, such as 127.0.0.1:8089 "
            '(emulator "model")'
        ),
        (
            "F:23: grpc.listen[0]: other hosts can reach 0.0.0.0:1 in plain text; add a [grpc.tls] "
            "table, or write insecure = true in the same section"
        ),
        "F:28: grpc.token[0].roles[0]: unknown role 'Read'; did you mean 'read'?",
        "F:30: injection[0].value: this key is needed for operation 'offset' (injection \"drift\")",
        ("F:38: injection[1].operation: unknown operation 'ofset'; did you mean 'offset'? (injection \"drift\")"),
    ]


def test_fault_in_a_properties_file_has_its_line(tmp_path: Path) -> None:
    (tmp_path / "plc.ini").write_text("# PLC\nhosst=10.0.0.1\nport=eleven\n")
    source = '[[source]]\nname = "c"\nconnector = "s7"\nlayout = "x.db"\nproperties = "plc.ini"\nperiod_ms = -1\n'
    file = tmp_path / "supervisor.toml"
    file.write_text(HEAD + source)
    with pytest.raises(ConfigError) as caught:
        prepare(file)
    place = tmp_path / "plc.ini"
    assert str(caught.value).split("\n") == [
        f"{place}:2: hosst: unknown key; did you mean 'host'? (source \"c\")",
        f"{place}:3: port: expected a whole number, found 'eleven' (source \"c\")",
        f'{file}:8: source[0].period_ms: expected a number >= 0.1, found -1 (source "c")',
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('log_dir = "a"\n\nname = "y"\n', "instance.name is given twice, in lines 2 and 5; remove one of them"),
        ("[grpc]\n[instance]\n", "instance is given twice, in lines 1 and 4; remove one of them"),
        ('log_dir = "C:\\Users\\me"\n', "write a path in single quotes"),
        ('log_dir = "C:\\plc"\n', "write a path in single quotes"),
        ('log_dir = "C:\\temp\\new"\n', "write a path with backslashes in single quotes"),
        ("[instanse]\n", "instanse: unknown key; did you mean 'instance'?"),
    ],
)
def test_common_mistake_is_reported_with_the_correction(tmp_path: Path, text: str, said: str) -> None:
    [line] = refused(tmp_path, HEAD + text)
    assert said in line


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    file = tmp_path / "supervisor.toml"
    file.write_text(HEAD, encoding="utf-8-sig")
    assert load(file).instance.name == "x"


def test_each_key_has_its_line() -> None:
    text = (
        '# a\na.\'b c\'."d" = 1 # [x]\n[t] # [u]\nlong = \'\'\'\nk = 1\n[z]\n\'\'\'\nmore = """\\"""\n[y]""""\n'
        "list = [[\n1], [2,\n# ]\n]]\nlast = {q = 1,\tr = [1]}\n[[s]]\nn = 1\n[s.p]\nv = 2\n[[s]]\n[[s.i]]\nw = 3\r\n"
    )
    lines = Lines(text)
    found = {key: lines.of(key) for key in ("a.b c.d", "t", "t.long", "t.more", "t.list", "t.last", "t.last.q")}
    assert found == {"a.b c.d": 2, "t": 3, "t.long": 4, "t.more": 8, "t.list": 10, "t.last": 14, "t.last.q": 14}
    assert [lines.of(key) for key in ("s[0].n", "s[0].p.v", "s[1]", "s[1].i[0].w", "s[1].none", "z", "none")] == [
        *(16, 18, 19, 21, 19, 0, 0)
    ]


@pytest.mark.parametrize(
    ("text", "lines", "said"),
    [
        (f"{HEAD}{'.'.join('a' * 20_000)} = 1\n", 1, "F:3: a key is longer than 1000 characters or 64 parts"),
        (f"[{'.'.join('a' * 20_000)}]\n", 1, "F:1: a key is longer"),
        (f"x = {{ y = 1, {'.'.join('a' * 20_000)} = 1 }}\n", 1, "F:1: a key is longer"),
        (f'{HEAD}"{"a" * 1001}" = 1\n', 1, "F:3: a key is longer"),
        (HEAD + "".join(f"k{i}.{'.'.join('a' * 100)} = 1\n" for i in range(4000)), 1, "F:3: a key is longer"),
        (HEAD + "".join(f"k{i}.{'.'.join('a' * 60)} = 1\n" for i in range(3000)), 1001, "instance.k0: unknown key"),
        (f"[{'.'.join('a' * 60)}]\n{'.'.join('b' * 60)} = 1\n", 1, "nested more than 64 deep"),
        (f"x = {'[' * 5000}{']' * 5000}", 1, "F: tables and lists are nested more than 64 deep"),
        (HEAD + "".join(f"k{i} = 1\n" for i in range(30_000)), 1001, "instance.k0: unknown key"),
        (
            HEAD + "[[source]]\n" * 30_000,
            401,
            "source: there are 30000 sources, but an instance has at most 200 processes",
        ),
        (
            HEAD + "[grpc]\nlisten = ['127.0.0.1:0']\n" + "[[grpc.token]]\n" * 9000,
            1001,
            "grpc.token: there are 9000 sections",
        ),
        (HEAD + "[[injection]]\noperation = 'ofset'\n" * 9000, 1001, "injection: there are 9000 sections"),
        (f'{HEAD}x = """{chr(92)}"""{chr(92) * 3}""" ' * 20_000, 1, "not valid TOML: "),
        (f"{HEAD}x = {chr(34) * 300_000}", 1, "not valid TOML: "),
        ("[" * 300_000, 1, "not valid TOML: "),
        (f'[instance]\nname = "{"x" * 900_000}"\n', 1, "instance.name: expected a name"),
        (f'{HEAD}[[source]]\nname = "s"\nconnector = "{"y" * 9000}"\nstale_ms = 1\n', 1, "stale_ms"),
    ],
)
def test_hostile_files_are_refused_with_a_bounded_number_of_lines(
    tmp_path: Path, text: str, lines: int, said: str
) -> None:
    told = refused(tmp_path, text)
    assert said in told[0]
    assert len(told) <= lines
    assert max(map(len, told)) < 700
    if lines > 1000:
        assert told[-1].endswith(" more faults")


@pytest.mark.parametrize("line", ['password = "hunter2', "password = hunter2", "api_key: hunter2"])
def test_a_secret_is_not_quoted(tmp_path: Path, line: str) -> None:
    (message,) = refused(tmp_path, f'[[source]]\nname = "cell"\n{line}\n')
    assert "hunter2" not in message
    assert "(at line 3, column " in message


def test_warnings_have_their_lines_also_for_the_sources_of_a_recording(tmp_path: Path) -> None:
    text = '[[source]]\nname = "cell"\n[[source]]\nname = "press"\nwritable = ["x"]\n[mqtt]\nport = 1\n'
    faults = Faults(tmp_path / "F", tomllib.loads(text), text)
    assert faults.warning("source[1].writable: odd") == f"{tmp_path}/F:5: warning: source[1].writable: odd"
    assert faults.warning("there is nothing") == f"{tmp_path}/F: warning: there is nothing"
    faults.play(["press", "robot"])
    assert faults.warning("source[0].writable: odd") == f"{tmp_path}/F:5: warning: source[1].writable: odd"
    assert faults.warning("source[1].writable: odd") == f"{tmp_path}/F: warning: source[2].writable: odd"
    assert faults.warning("mqtt.port: odd") == f"{tmp_path}/F:7: warning: mqtt.port: odd"
    faults.add("source[1].layout: wrong")
    with pytest.raises(ConfigError, match=r'F: source\[2\].layout: wrong \(source "robot"\)$'):
        faults.raise_any()
