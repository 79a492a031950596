"""``supervisor.toml``: valid configurations, and errors."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shmio.config import Address, load
from shmio.config.read import unknown_option
from shmio.errors import ConfigError

WHOLE = """
[instance]
name = "a50"
log_dir = "var/log"
group = "twins"
ring_mb = 8

[[source]]
name = "cell"
connector = "s7"
layout = "db201.db"
properties = "plc.ini"
period_ms = 20
writable = ["Outputs", "Robot_*/*"]
armed = false
slot = 2

[[emulator]]
name = "plc"
kind = "s7"
layout = "db201.db"
program = "a50"
listen = "127.0.0.1:1102"

[grpc]
listen = ["127.0.0.1:8089", "[::1]:8090"]
default_source = "cell"
"""
INI = "model=S7_1500\nhost=10.76.0.12\nport=102\nrack=0\nslot=1\ntimeout=5000\npacketSize=96\ndbNumber=201\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plc.ini").write_text(INI)
    return tmp_path


def written(folder: Path, text: str) -> Path:
    file = folder / "supervisor.toml"
    file.write_text(text)
    return file


def test_all_sections_are_read(folder: Path) -> None:
    config = load(written(folder, WHOLE))
    assert (config.instance.name, config.instance.group, config.instance.ring_mb) == ("a50", "twins", 8)
    assert config.instance.clock == "wall"
    assert config.log_dir == folder / "var/log"
    (source,) = config.source
    assert (source.name, source.period_ns, source.writable) == ("cell", 20_000_000, ["Outputs", "Robot_*/*"])
    assert config.path("db201.db") == folder / "db201.db"
    assert config.emulator[0].program == "a50"
    assert load(written(folder, WHOLE.replace('program = "a50"\n', ""))).emulator[0].program == "idle"
    assert load(written(folder, WHOLE.replace('program = "a50"\n', 'folder = "x"\n'))).emulator[0].folder == "x"
    assert config.grpc is not None
    assert config.grpc.listen == ["127.0.0.1:8089", "[::1]:8090"]


def test_inline_keys_win_over_properties(folder: Path) -> None:
    [source] = load(written(folder, WHOLE)).source
    assert source.options == {"slot": 2}
    assert source.texts == {
        "model": "S7_1500",
        "host": "10.76.0.12",
        "port": "102",
        "rack": "0",
        "timeout": "5000",
        "packetSize": "96",
        "dbNumber": "201",
    }


def test_a_layout_may_be_several_files(folder: Path) -> None:
    text = WHOLE.replace('layout = "db201.db"', 'layout = ["u.db", "u.udt"]\nblock = "Cell"')
    text = text.replace("program =", "dbNumber = 7\nprogram =")
    config = load(written(folder, text))
    for section in (config.source[0], config.emulator[0]):
        assert (section.layout, section.block) == (["u.db", "u.udt"], "Cell")
    assert config.emulator[0].dbNumber == 7


@pytest.mark.parametrize(("period_ms", "stale_ms"), [(20, 500), (1, 500), (1000, 5000)])
def test_default_stale_time_is_five_periods_but_at_least_half_a_second(
    folder: Path, period_ms: int, stale_ms: int
) -> None:
    text = WHOLE.replace("period_ms = 20", f"period_ms = {period_ms}")
    assert load(written(folder, text)).source[0].stale_ns == stale_ms * 1_000_000
    text = text.replace("armed = false", "stale_ms = 2400")
    assert load(written(folder, text)).source[0].stale_ns == 2_400_000_000


def test_tls_files_are_relative_to_the_config(folder: Path) -> None:
    text = (
        WHOLE.replace('"127.0.0.1:8089"', '"0.0.0.0:8089"') + '[grpc.tls]\ncertificate = "cert.pem"\nkey = "/k.pem"\n'
    )
    config = load(written(folder, text))
    assert config.grpc is not None
    assert config.grpc.tls is not None
    assert (config.grpc.tls.certificate, config.grpc.tls.key) == (str(folder / "cert.pem"), "/k.pem")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[instance]", "[instanse]", r"instanse: unknown key; did you mean 'instance'\?"),
        ("ring_mb", "ring_megabytes", r"instance\.ring_megabytes: unknown key"),
        ('connector = "s7"', 'conector = "s7"', r"source\[0\]\.conector: unknown key; did you mean 'connector'\?"),
        ("ring_mb = 8", 'clock = "walls"', r"instance\.clock: unknown clock 'walls'; did you mean 'wall'"),
        ("ring_mb = 8", 'ring_mb = "8"', r"instance\.ring_mb: expected a number, found '8'"),
        ("ring_mb = 8", "ring_mb = 0", r"instance\.ring_mb: expected a number > 0"),
        ('name = "a50"\n', "", r"instance\.name: this key is needed"),
        ('name = "a50"', 'name = "a/50"', r"instance\.name: expected a name: at most 40 letters, digits and _ \. -"),
        ('name = "a50"', 'name = ""', r"instance\.name: "),
        ("[[source]]", "[source]", r"source: write \[\[source\]\]"),
        ("[[emulator]]", "[emulator]", r"emulator: write \[\[emulator\]\]"),
        ('layout = "db201.db"', "layout = []", r'source\[0\]\.layout: must not be empty \(source "cell"\)$'),
        (
            'layout = "db201.db"',
            "layout = 5",
            r"source\[0\]\.layout: expected text or a list in \[ \], found \d+",
        ),
        ("armed = false", "armed = 1", r"source\[0\]\.armed: expected true or false, found 1"),
        ("armed = false", "stale_ms = 30", r"source\[0\]\.stale_ms: 30 is less than two periods of 20 ms"),
        ('name = "cell"', 'name = "Model"', r"source\[0\]\.name: 'Model' is reserved"),
        ('name = "cell"', 'name = "grpc"', r"source\[0\]\.name: 'grpc' is the name of one of shmio's processes"),
        ('name = "plc"', 'name = "CELL"', r"emulator\[0\]\.name: 'CELL' is already the name of source\[0\]"),
        ("period_ms = 20", "period_ms = 0", r"source\[0\]\.period_ms: expected"),
        ("period_ms = 20", "period_ms = nan", r"source\[0\]\.period_ms: "),
        ('"Robot_*/*"', "5", r"source\[0\]\.writable\[1\]: expected text, found 5"),
        (
            "[instance]",
            "[recorder]\ndirectroy = 'x'\n[instance]",
            r"recorder\.directroy: unknown key; did you mean 'directory'",
        ),
        ("[instance]", "[recorder]\nbuffer_mb = 0\n[instance]", r"recorder\.buffer_mb: expected a number > 0"),
        (
            "[instance]",
            "[recorder]\nrotate_mb = 0.5\n[instance]",
            r"recorder\.rotate_mb: 0\.5 is less than 1 .*write 0",
        ),
        (
            "[instance]",
            "[recorder]\nrotate_min = 1e-3\n[instance]",
            r"recorder\.rotate_min: 0\.001 is less ",
        ),
        (
            "[instance]",
            '[recorder]\nsources = ["x"]\n[instance]',
            r"recorder\.sources: unknown source 'x'; valid: ",
        ),
        ("[instance]", "[recorder.trigger]\nbefore_s = 1\n[instance]", r"recorder\.trigger\.when: this key is needed"),
        ('kind = "s7"\n', "", r'emulator\[0\]\.kind: this key is needed \(emulator "plc"\)$'),
        (
            'program = "a50"',
            'programm = "a50"',
            r"emulator\[0\]\.(programm: unknown key; did you mean 'program'|program: )",
        ),
        ('"127.0.0.1:1102"', '"1102"', r"emulator\[0\]\.listen: '1102' is not an address"),
        ('"127.0.0.1:1102"', '"0.0.0.0:1102"', r"emulator\[0\]\.listen: .*insecure = true"),
        ('"[::1]:8090"', '"::1:8090"', r"grpc\.listen\[1\]: .*brackets"),
        ('"[::1]:8090"', '"host:8090"', r"grpc\.listen\[1\]: .*grpc\.tls.*insecure = true"),
        ('"[::1]:8090"', '"127.0.0.1:99999"', r"grpc\.listen\[1\]: "),
        (
            'default_source = "cell"',
            'default_source = "sell"',
            r"grpc\.default_source: unknown source 'sell'; did you mean 'cell'",
        ),
        ('"plc.ini"', '"nowhere.ini"', r"source\[0\]\.properties: .*nowhere\.ini: No such file"),
        ("[grpc]", "[web]\nlisten = '127.0.0.1:1'\nprefix = 'x'\n[grpc]", r"web\.prefix: unknown key"),
        ("[grpc]", "[web]\nlisten = '0.0.0.0:8080'\n[grpc]", r"web\.listen: .* in plain text"),
        ("[grpc]", "[web]\nlisten = '0.0.0.0:8080'\ninsecure = true\n[grpc]", r"web\.roles: other hosts can reach"),
        ("[grpc]", "[web]\nlisten = '127.0.0.1:1'\nroles = ['admin']\n[grpc]", r"web\.roles: unknown role 'admin'"),
        ("[grpc]", "[web]\nlisten = '127.0.0.1:1'\nroles = []\n[grpc]", r"web\.roles: nobody could use the page"),
        ("[instance]", 'folder = "/"\n[instance]', r"folder: unknown key"),
        ("[instance]", "[instance", r"not valid TOML"),
        ("[instance]", f"digits = {'9' * 5000}\n[instance]", r"a number has too many digits"),
        ('"var/log"', '"var\\u0000log"', r"instance\.log_dir: must not contain control characters"),
    ],
)
def test_fault_is_named_by_its_full_key(folder: Path, old: str, new: str, message: str) -> None:
    assert old in WHOLE
    with pytest.raises(ConfigError, match=message) as caught:
        load(written(folder, WHOLE.replace(old, new, 1)))
    assert str(caught.value).startswith(str(folder))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "a50"', "name = a50", 'name = a50; write text in quotes: "a50"'),
        ('name = "a50"', "name = “a50”", 'name = “a50”; write text in quotes: "a50"'),
        ('name = "a50"', 'name = "a50', 'name = "a50; the closing quote is missing'),
        ("armed = false", "armed = False  # yet", "armed = False  # yet; write false"),
        ("slot = 2", "host = 10.76.0.12", 'host = 10.76.0.12; write text in quotes: "10.76.0.12"'),
        ('"127.0.0.1:1102"', "127.0.0.1:1102", 'listen = 127.0.0.1:1102; write text in quotes: "127.0.0.1:1102"'),
        ('"[::1]:8090"', "localhost:8090", '; write text in quotes: "localhost:8090"'),
        ('["Outputs", "Robot_*/*"]', "[\n  Outputs\n]", 'Outputs; write text in quotes: "Outputs"'),
        ('"var/log"', "/var/log", '= /var/log; write text in quotes: "/var/log"'),
        ("period_ms = 20", "period_ms = 020", "period_ms = 020"),
        ("period_ms = 20", "period_ms: 20", "period_ms: 20"),
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_toml_mistake_is_shown_with_the_correction(folder: Path, old: str, new: str, said: str, end: str) -> None:
    assert old in WHOLE
    (folder / "supervisor.toml").write_text(WHOLE.replace(old, new, 1), newline=end)
    with pytest.raises(ConfigError, match=r"not valid TOML: .* \(at line \d+, column \d+\): ") as caught:
        load(folder / "supervisor.toml")
    assert str(caught.value).endswith(said)
    assert "\n" not in str(caught.value)


def test_plain_text_to_other_hosts_needs_insecure(folder: Path) -> None:
    text = WHOLE.replace('"127.0.0.1:8089"', '"0.0.0.0:8089"')
    with pytest.raises(ConfigError, match="insecure"):
        load(written(folder, text))
    assert load(written(folder, text.replace("[grpc]", "[grpc]\ninsecure = true"))).grpc is not None


def test_a_missing_file_is_named_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml: No such file or directory; .*init"):
        load(tmp_path / "nowhere.toml")


def test_file_that_is_not_utf8_or_too_large_is_refused(folder: Path) -> None:
    (folder / "supervisor.toml").write_bytes(b"name = '\xff'")
    with pytest.raises(ConfigError, match="not UTF-8 at byte 8; save it as UTF-8"):
        load(folder / "supervisor.toml")
    for encoding in ("utf-16", "utf-16-le"):
        (folder / "supervisor.toml").write_bytes("[instance]".encode(encoding))
        with pytest.raises(ConfigError, match=r"UTF-16.*; save it as UTF-8"):
            load(folder / "supervisor.toml")
    (folder / "supervisor.toml").write_bytes(b"#" * (1 << 21))
    with pytest.raises(ConfigError, match="larger than"):
        load(folder / "supervisor.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [("host", r":1: expected key=value"), ("a=1\n=2", r":2: expected"), ("a=1\n\na=2", r":3: a is given twice")],
)
def test_faulty_line_of_the_properties_is_named(folder: Path, text: str, message: str) -> None:
    (folder / "plc.ini").write_text(text)
    with pytest.raises(ConfigError, match=r"source\[0\]\.properties.*" + message):
        load(written(folder, WHOLE))


def test_properties_may_have_comments_sections_and_a_bom(folder: Path) -> None:
    (folder / "plc.ini").write_bytes(b"\xef\xbb\xbf# PLC\r\n; two\r\n[s7]\r\n host = a = b \r\n\r\n")
    assert load(written(folder, WHOLE)).source[0].texts == {"host": "a = b"}


def test_unknown_option_is_refused_with_the_nearest_name() -> None:
    known = ["host", "packetSize"]
    assert unknown_option(1, "packetsize", known) == "source[1].packetsize: unknown key; did you mean 'packetSize'?"
    assert "did you mean 'period_ms'?" in unknown_option(0, "perid_ms", known)
    assert "host, packetSize" in unknown_option(0, "zzz", known)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(alphabet=WHOLE + '{}"\\\x00é', max_size=300))
def test_any_text_is_read_or_refused(folder: Path, text: str) -> None:
    (folder / "supervisor.toml").write_text(text, encoding="utf-8", newline="")
    with suppress(ConfigError):
        load(folder / "supervisor.toml")


@pytest.mark.parametrize(
    ("text", "loopback"),
    [
        ("127.0.0.1:1", True),
        ("127.9.9.9:1", True),
        ("[::1]:1", True),
        ("localhost:1", True),
        ("0.0.0.0:1", False),
        ("[::]:1", False),
        ("192.168.0.5:1", False),
        ("localhost.evil.example:1", False),
    ],
)
def test_loopback_addresses(text: str, loopback: bool) -> None:
    address = Address.parse(text)
    assert (str(address), address.loopback) == (text, loopback)


@pytest.mark.parametrize("text", ["", ":1", "host", "host:", "host:-1", "host:٣", "host:65536", "::1:5"])
def test_invalid_address_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        Address.parse(text)


def test_tags_are_files_of_the_layout(tmp_path: Path) -> None:
    head = '[instance]\nname = "a"\n[[source]]\nname = "line"\nconnector = "modbus"\nhost = "h"\n'
    for keys, expected in (
        ('tags = "a.toml"', ["a.toml"]),
        ('layout = "b.db"\ntags = "a.csv"', ["b.db", "a.csv"]),
        ('layout = ["b.db", "c.udt"]\ntags = ["a.csv"]', ["b.db", "c.udt", "a.csv"]),
        ('layout = "b.db"', "b.db"),
    ):
        (tmp_path / "supervisor.toml").write_text(f"{head}{keys}\n")
        source = load(tmp_path / "supervisor.toml").source[0]
        assert (source.layout, source.tags) == (expected, None)
