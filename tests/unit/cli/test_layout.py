from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path

import pytest

from shmio import __version__
from shmio.cli.layout import main

GOLDEN = Path(__file__).parents[2] / "golden" / "layout"
DB = 'DATA_BLOCK "one" STRUCT a : "T"; END_STRUCT; BEGIN END_DATA_BLOCK\n'
UDT = "TYPE T STRUCT x : Bool; // flag\n y : Array[0..1] of Int := [1, 2]; END_STRUCT; END_TYPE\n"


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    (tmp_path / "a.db").write_text(DB, encoding="utf-8-sig")
    (tmp_path / "t.udt").write_text(UDT)
    return str(tmp_path / "a.db"), str(tmp_path / "t.udt")


def test_json_of_one_block(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(GOLDEN / "db201-as-printed.db"), "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out) == json.loads((GOLDEN / "db201-as-printed.json").read_bytes())
    assert "Optimized block access" in captured.err
    assert all(": warning: " in line for line in captured.err.splitlines())


def test_json_of_several_blocks(files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "b.db").write_text(DB.replace("one", "two"))
    assert main([files[0], "--json", str(tmp_path / "b.db"), files[1]]) == 0
    assert [layout["name"] for layout in json.loads(capsys.readouterr().out)] == ["one", "two"]


def test_table(files: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(list(files)) == 0
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [
        "one: 6 bytes, 2 registers, standard access",
        "offset  size  type                path  initial  comment",
        "   0.0     1  BOOL                a/x            flag",
        "     2     4  ARRAY[0..1] OF INT  a/y   [1, 2]",
    ]
    assert captured.err == ""


def test_initial_values_that_cannot_be_read_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    members = "a : Int := \"X\"; b : Array[0..1] of Real := [1.0, 'x']; c : Int := 1;"
    (tmp_path / "a.db").write_text(f"DATA_BLOCK b STRUCT {members} END_STRUCT; BEGIN END_DATA_BLOCK")
    assert main([str(tmp_path / "a.db"), "--json"]) == 0
    captured = capsys.readouterr()
    assert [register["initial"] for register in json.loads(captured.out)["registers"]] == ['"X"', "[1.0, 'x']", "1"]
    assert captured.err.splitlines() == [
        'b: warning: the initial value "X" of a cannot be read as INT; an emulated PLC starts it at 0',
        "b: warning: the initial value [1.0, 'x'] of b cannot be read as REAL; an emulated PLC starts it at 0.0",
    ]


def test_many_initial_values_that_cannot_be_read_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    members = "".join(f"a{i} : Int := X;" for i in range(25))
    (tmp_path / "a.db").write_text(f"DATA_BLOCK b STRUCT {members} END_STRUCT; BEGIN END_DATA_BLOCK")
    assert main([str(tmp_path / "a.db")]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert (len(lines), lines[-1]) == (21, "b: warning: 5 more initial values cannot be read")


def test_table_escapes_control_characters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.db").write_text('DATA_BLOCK "b" STRUCT a : Int; // \x1b[2J\u202e\nEND_STRUCT; BEGIN END_DATA_BLOCK')
    assert main([str(tmp_path / "a.db")]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert "\\x1b[2J\\u202e" in out


def test_errors_name_file_line_and_column(files: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([files[0], "--json"]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {"error": captured.err.rstrip()}
    assert captured.err.startswith(f"{files[0]}:1:29: error: unknown type 'T'")
    assert len(captured.err.splitlines()) == 1


def test_files_that_cannot_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "utf16.db").write_bytes(b"\xff\xfea")
    for name, message in (
        ("none.db", "No such file"),
        (".", "Is a directory"),
        ("utf16.db", "utf16.db:1:1: error: the file has the byte order mark of UTF-16-LE"),
    ):
        assert main([str(tmp_path / name)]) == 1
        captured = capsys.readouterr()
        assert message in captured.err
        assert len(captured.err.splitlines()) == 1


@pytest.mark.parametrize("arguments", [[], ["--nope", "x.db"], ["--json"]])
def test_wrong_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage:" in capsys.readouterr().err


def test_terminals_that_are_not_utf8(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.db").write_text(
        'DATA_BLOCK "b" STRUCT "轴" : Int; END_STRUCT; BEGIN END_DATA_BLOCK', encoding="utf-8"
    )
    for arguments, text in ((["--json"], '"path": "\\u8f74"'), ([], "\\u8f74")):
        out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
        monkeypatch.setattr(sys, "stdout", out)
        assert main([str(tmp_path / "a.db"), *arguments]) == 0
        out.seek(0)
        assert text in out.read()


def test_closed_pipe_ends_the_command_silently(tmp_path: Path) -> None:
    members = "".join(f"a{i} : Int;\n" for i in range(20_000))
    (tmp_path / "a.db").write_text(f'DATA_BLOCK "b" STRUCT {members} END_STRUCT; BEGIN END_DATA_BLOCK')
    command = [sys.executable, "-m", "shmio.cli.layout", str(tmp_path / "a.db")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith(b"b: 40000 bytes")
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 141  # 128 + SIGPIPE


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"shmio {__version__}\n"


def test_one_block_of_several(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.db"
    path.write_text(
        'DATA_BLOCK "Timers" STRUCT t : TON_TIME; END_STRUCT; BEGIN END_DATA_BLOCK\n'
        'DATA_BLOCK "Plain" STRUCT a : Array[0..99] of Int; END_STRUCT; BEGIN END_DATA_BLOCK\n'
    )
    assert main([str(path)]) == 1
    assert 'type_bytes = { "TON_TIME" = … } in the configuration' in capsys.readouterr().err
    assert main([str(path), "--block", "plain", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["size"] == 200
    assert main([str(path), "--type-bytes", "TON_TIME=18", "--type-bytes", "Nope=2"]) == 0
    captured = capsys.readouterr()
    assert "Timers: 18 bytes" in captured.out
    assert captured.err == "warning: --type-bytes: no member has the type 'Nope'\n"
    assert main([str(path), "--block", "other"]) == 1
    assert "--block: unknown data block 'other'; valid: Timers, Plain" in capsys.readouterr().err


@pytest.mark.parametrize("size", ["TON_TIME", "=1", "TON_TIME=0", "TON_TIME=9999999", "TON_TIME=x"])
def test_invalid_type_size_is_wrong_usage(size: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["a.db", "--type-bytes", size])
    assert "expected a type and its bytes" in capsys.readouterr().err


def test_an_imported_table_names_all_of_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    block = '<Document><SW.Blocks.GlobalDB><AttributeList><Interface><Sections><Section Name="Static"><Member Name="a" '
    block += 'Datatype="Int" /></Section></Sections></Interface><Name>{0}</Name><Number>{1}</Number></AttributeList>'
    block += "</SW.Blocks.GlobalDB></Document>"
    files = [tmp_path / "one.xml", tmp_path / "two.xml"]
    for number, file in enumerate(files, 1):
        file.write_text(block.format(file.stem, number))
    assert main(["import", *map(str, files)]) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith("imported from one.xml, two.xml")
