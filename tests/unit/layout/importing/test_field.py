"""Lists and sources as plants have them: each value that stands in the file is imported, or named as left out."""

from __future__ import annotations

import datetime
import io
import re
from pathlib import Path

import openpyxl
import pytest

from shmio.cli.layout import main
from shmio.errors import LayoutError
from shmio.layout.addresses import modbus, siemens
from shmio.layout.compiler import Program, Source, compile_sources
from shmio.layout.foreign import foreign
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.importing.importer import import_tags
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags

FIELD = Path(__file__).parents[3] / "field"
KEP = (
    "Tag Name,Address,Data Type,Respect Data Type,Client Access,Scan Rate,Scaling,Raw Low,Raw High,Scaled Low,"
    "Scaled High,Scaled Data Type,Clamp Low,Clamp High,Eng Units,Description,Negate Value\n"
)


def imported(name: str, *further: str, **options: object) -> Found:
    sources = [Source(one, (FIELD / one).read_bytes()) for one in further]
    return import_tags((FIELD / name).read_bytes(), name, further=sources, **options)  # type: ignore[arg-type]


def places(found: Found) -> dict[str, tuple[object, object]]:
    """Return the type and address of each tag, after a check that the table compiles."""
    compile_sources([Source("x.toml", found.to_toml("x", writable=True).encode())])
    return {path: (entry["type"], entry.get("address", "")) for path, entry in found.tags.items()}


def left_out(found: Found) -> dict[str, int]:
    return {name: line for items in found.skipped.values() for name, line in items}


def offsets(layout: Layout) -> dict[str, str]:
    return {one.path: f"{one.offset}" if one.bit is None else f"{one.offset}.{one.bit}" for one in layout.registers}


def kep(address: str, data_type: str, rest: str = "R/W,100,,,,,,,,,,,") -> Found:
    return import_tags(f'{KEP}"x","{address}",{data_type},1,{rest}\n'.encode())


def test_lists_of_the_field() -> None:
    blocks = {
        "s7/tia_ui_tagtable.xml": {"Guard": ("Bool", "%I0.3"), "Feed rate": ("Real", "%MD40")},
        "s7/tia_sdf_9col.sdf": {"Guard": ("Bool", "%I0.3"), "Feed rate": ("Real", "%MD40")},
        "s7/percent_rows.csv": {"Valve": ("Bool", "%Q0.1"), "Level": ("Int", "%IW64")},
        "s7/quotes_comma.sdf": {"Arm": ("BOOL", "%I0.1")},
        "s7/ml_instance_of_fb.xml": {
            "Start": ("BOOL", "%DB22.DBX0.0"), "Done": ("BOOL", "%DB22.DBX2.0"), "n": ("INT", "%DB22.DBW4")
        },
        "s7/ml_fb_member.xml": {
            "m/Start": ("BOOL", "%DB24.DBX0.0"), "m/Done": ("BOOL", "%DB24.DBX2.0"), "m/n": ("INT", "%DB24.DBW4"),
            "z": ("INT", "%DB24.DBW6"),
        },
        "s7/ml_dtl.xml": {
            "at": ("DTL", "%DB27.DBX0.0"), "hist": ("ARRAY[0..1] OF DTL", "%DB27.DBX12.0"), "z": ("INT", "%DB27.DBW36")
        },
        "s7/kep_arrays.csv": {
            "A/Mtx": ("ARRAY[0..1, 0..2] OF INT", "DB5.DBW40"), "A/Mtx2": ("ARRAY[0..1, 0..2] OF UINT", "400100"),
            "A/S": ("STRING[20]", "DB5.DBX8.0"),
        },
        "s7/kep_s7.csv": {
            "Cell/Door": ("BOOL", "DB5.DBX0.1"), "Cell/Count": ("INT", "DB5.DBW2"), "Cell/Speed": ("REAL", "DB5.DBD4"),
            "Cell/Name": ("STRING[20]", "DB5.DBX8.0"), "Cell/Tab": ("ARRAY[0..4] OF INT", "DB5.DBW30"),
            "Cell/Mtx": ("ARRAY[0..1, 0..2] OF INT", "DB5.DBW40"), "Cell/Bit": ("BOOL", "DB5.DBX60.3"),
            "Cell/Byte": ("USINT", "DB5.DBB61"), "Cell/Flag": ("BOOL", "M10.2"), "Cell/Word": ("UINT", "MW12"),
            "Cell/Date": ("DATE", "DB5.DBW64"),
        },
        "protocols/kep_modbus_array.csv": {"Curve": ("ARRAY[0..4] OF REAL", "400010")},
        "protocols/kep_modbus_scaled.csv": {"Pump/Speed": ("REAL", "400101 UINT"), "Pump/Plain": ("UINT", "400101")},
    }  # fmt: skip
    skipped = {
        "s7/tia_ui_tagtable.xml": {"STATIONS": 5}, "s7/tia_sdf_9col.sdf": {"STATIONS": 3},
        "s7/quotes_comma.sdf": {"Clamp": 1}, "s7/kep_s7.csv": {"Cell.Bcd": 12},
    }  # fmt: skip
    for name, expected in blocks.items():
        found = imported(name)
        assert places(found) == expected, name
        assert left_out(found) == skipped.get(name, {}), name


def test_a_scaled_row_of_kepserver_reads_the_raw_number() -> None:
    found = imported("protocols/kep_modbus_scaled.csv")
    for path, value in (("Pump/Speed", 50.5), ("Pump/Plain", 505)):
        register = place_tags("x", {path: found.tags[path]}).registers[0]
        codec = modbus.WordCodec(modbus.parse(register), register, "big", "big")
        assert codec.decode((505).to_bytes(2, "big")) == value


def test_addresses_of_kepserver() -> None:
    good = {
        ("400001", "Word"): ("UINT", "400001"), ("40001", "Short"): ("INT", "40001"), ("41", "Word"): ("UINT", "40001"),
        ("465536", "Word"): ("UINT", "465536"), ("H4000A", "Word"): ("UINT", "40010"),
        ("300005", "Float"): ("REAL", "300005"),
        ("000001", "Boolean"): ("BOOL", "000001"), ("100017", "Boolean"): ("BOOL", "100017"),
        ("400001.3", "Boolean"): ("BOOL", "400001.3"), ("400001.15", "Default"): ("BOOL", "400001.15"),
        ("400100.20H", "String"): ("STRING[20]", "400100"), ("400100.20L", "String"): ("STRING[20]", "400100"),
        ("400001", "Default"): ("UINT", "400001"),
        ("000001 [8]", "Boolean Array"): ("ARRAY[0..7] OF BOOL", "000001"),
        ("400010 [2][3]", "Long Array"): ("ARRAY[0..1, 0..2] OF DINT", "400010"),
        ("400001", "QWord"): ("ULINT", "400001"), ("400001", "Double"): ("LREAL", "400001"),
        ("DB5,INT2", "Short"): ("INT", "DB5.DBW2"), ("DB5.REAL4", "Float"): ("REAL", "DB5.DBD4"),
        ("DB5,X60.3", "Boolean"): ("BOOL", "DB5.DBX60.3"), ("DB5.DBX0.1", "Boolean"): ("BOOL", "DB5.DBX0.1"),
        ("DB5,B61.3", "Boolean"): ("BOOL", "DB5.DBX61.3"), ("db5,dint6", "Long"): ("DINT", "DB5.DBD6"),
        ("DB5,D8", "Float"): ("REAL", "DB5.DBD8"), ("DB5.DBW4", "Word"): ("UINT", "DB5.DBW4"),
        ("DB5,CHAR1", "Char"): ("SINT", "DB5.DBB1"), ("DB5,W2", "Default"): ("UINT", "DB5.DBW2"),
        ("DB5,DI2", "Default"): ("DINT", "DB5.DBD2"), ("DB5,STRING0.254", "String"): ("STRING[254]", "DB5.DBX0.0"),
        ("DB5,DT10", "String"): ("DATE_AND_TIME", "DB5.DBX10.0"), ("DB5,LREAL10", "Double"): ("LREAL", "DB5.DBX10.0"),
        ("DB5,X4.0[16]", "Boolean Array"): ("ARRAY[0..15] OF BOOL", "DB5.DBX4.0"),
        ("M10.2", "Boolean"): ("BOOL", "M10.2"), ("F10.2", "Boolean"): ("BOOL", "M10.2"),
        ("MW12", "Word"): ("UINT", "MW12"),
        ("MREAL14", "Float"): ("REAL", "MD14"), ("EB3", "Byte"): ("USINT", "IB3"),
        ("A0.1", "Boolean"): ("BOOL", "Q0.1"),
        ("QX0.1", "Boolean"): ("BOOL", "Q0.1"), ("PIW256", "Short"): ("INT", "IW256:P"),
        ("PEW256", "Word"): ("UINT", "IW256:P"),
        ("T5", "Long"): ("TIME", "T5"), ("C5", "Word"): ("UINT", "C5"), ("Z5", "Short"): ("INT", "C5"),
        ("MD20 [4]", "DWord Array"): ("ARRAY[0..3] OF UDINT", "MD20"),
    }  # fmt: skip
    for (address, data_type), expected in good.items():
        assert places(kep(address, data_type)) == {"x": expected}, address
    assert kep("400100.20L", "String").tags["x"]["byte_order"] == "little"
    assert "byte_order" not in kep("400100.20H", "String").tags["x"]
    bad = [
        ("DB5,WORD62", "BCD"), ("400001", "LBCD"), ("400001", "Date"), ("400001", "Boolean"), ("400001.16", "Boolean"),
        ("000001", "Word"), ("000001#16", "Word"), ("400100", "String"), ("400000", "Word"),
        ("40000A", "Word"), ("200001", "Word"), ("400001 [0]", "Word Array"), ("400001 [2][3][4]", "Word Array"),
        ("400001 [3]", "Word"), ("400001", "Word Array"), ("400001.3 [4]", "Boolean Array"), ("DB5,INT2", "Float"),
        ("DB5,INT2", "Long"), ("DB5,REAL4", "Double"), ("DB5,INT2", "Boolean"), ("DB5,INT2.3", "Short"),
        ("DB5,STRING8", "String"), ("DB5,STRING8.0", "String"), ("DB5,STRING8.255", "String"),
        ("DB5,BYTE8.20", "String"),
        ("DB5,W60.11", "Boolean"), ("DB5,X60.8", "Boolean"), ("DB5,X60", "Boolean"), ("DB0,INT2", "Short"),
        ("DB5,INT65536", "Short"), ("DB5,X0.1[8]", "Boolean Array"), ("PQW256", "Word"), ("DB5,FOO2", "Short"),
        ("VW100", "Word"),
        ("R0001", "Word"), ("RAMP(1,2)", "Word"), ("", "Word"), ("T5", "Word"), ("N7:0", "Short"),
        ("DB5,INT65535", "Short"),
    ]  # fmt: skip
    for address, data_type in bad:
        found = kep(address, data_type)
        assert not found.tags, (address, found.tags)
        assert left_out(found) == {"x": 2}, address


def test_scaling_access_and_width_of_rows_of_kepserver() -> None:
    linear = "Linear,0,1000,0,100,Float,{},0,,,{}"
    clamped = kep("400001", "Word", f"R/W,100,{linear.format(1, 0)}")
    assert clamped.tags["x"]["scale"] == [0.1, 0.0]
    assert "x (line 2)" in clamped.remarks[0]
    assert kep("400001", "Word", f"RO,100,{linear.format(0, 1)}").tags["x"]["scale"] == [-0.1, 0.0]
    assert kep("DB5,INT2", "Short", f"R/W,100,{linear.format(0, 0)}").tags["x"]["address"] == "DB5.DBW2 INT"
    same = kep("400001", "Float", f"R/W,100,{linear.format(0, 0)}")
    assert (same.tags["x"]["address"], same.tags["x"]["type"]) == ("400001", "REAL")
    for rest in (
        "R/W,100,Square Root,0,10,0,10,Double,0,0,,,0", "R/W,100,Linear,5,5,0,10,Double,0,0,,,0",
        "R/W,100,Linear,0,10,0,10,,0,0,,,0", "R/W,100,Linear,0,10,0,10,String,0,0,,,0", "WO,100,,,,,,,,,,,",
        "R/W,100,Linear,0,x,0,10,Double,0,0,,,0", "R/W,100,Linear,0,1000", "R/W,100,,,,,,,,,,say \"a,b\" now,,7",
    ):  # fmt: skip
        assert left_out(kep("400001", "Word", rest)) == {"x": 2}, rest
    assert left_out(kep("400001.3", "Boolean", "R/W,100,Linear,0,10,0,10,Double,0,0,,,0")) == {"x": 2}
    assert "writable" not in kep("300001", "Word").tags["x"]  # an input register
    assert kep("400001", "Word").tags["x"]["writable"] is True


def test_rows_that_are_damaged_cost_only_themselves() -> None:
    found = import_tags(
        b'"A","I 0.0","BOOL","open quote\r\n"B","I 0.1","BOOL",""\r\n"C","I 0.2","BOOL"\r\n"D","DB 5","DB 5",""\r\n'
    )
    assert list(found.tags) == ["A", "B"]
    assert left_out(found) == {"C": 3, "D": 4}
    assert import_tags(b'"A","I 0.0","BOOL","say "x" now"\r\n').tags["A"]["comment"] == 'say "x" now'
    rows = f'{KEP}"a","400001",Word,1,R/W,100,,,,,,,,,,"no end,\n"b","400002",Word,1,R/W,100,,,,,,,,,,,\n'
    found = import_tags(rows.encode())
    assert (list(found.tags), left_out(found)) == (["b"], {"a": 2})
    found = import_tags(
        b"126,red                     Q      0.0  BOOL      \r\nnot a row\r\n126,                        Q 0.1\r\n"
    )
    assert (list(found.tags), left_out(found)) == (["red"], {"not a row": 2, "a row": 3})


def test_lists_with_a_header_row() -> None:
    tia = (
        '"Name","Logical Address","Data Type","Hmi Visible","Hmi Accessible","Retain","Comment","Value",'
        '"Hmi Writeable"\r\n'
        '"Go","%M0.1","Bool","True","True","False","go","","True"\r\n'
    )
    german = "Name;Pfad;Datentyp;Logische Adresse;Kommentar\r\nLos;x;Bool;%A0.1;ja\r\n"
    for text, expected in ((tia, {"Go": ("Bool", "%M0.1")}), (german, {"Los": ("Bool", "%Q0.1")})):
        assert places(import_tags(text.encode())) == expected
    assert import_tags(tia.encode()).tags["Go"] == {
        "type": "Bool", "address": "%M0.1", "comment": "go", "writable": True
    }  # fmt: skip


def test_the_encoding_of_a_list_is_given_or_doubted() -> None:
    found = imported("s7/step7_gbk.sdf", encoding="gbk")
    assert places(found) == {"水泵运行": ("BOOL", "%I0.0"), "阀门 开": ("BOOL", "%Q4.1")}
    assert found.tags["水泵运行"]["comment"] == "运行反馈"
    assert not found.remarks
    assert "not UTF-8" in imported("s7/step7_gbk.sdf").remarks[0]
    with pytest.raises(ImportingError, match="line 1: the bytes here are not shift-jis"):
        import_tags(b'"\x81","I 0.0","BOOL",""\r\n', encoding="shift-jis")
    with pytest.raises(ValueError, match="unknown encoding 'gbkk'"):
        imported("s7/step7_gbk.sdf", encoding="gbkk")


def test_types_of_a_cpu_are_read_by_their_alias() -> None:
    found = imported("s7/s7_nodeset.xml")
    assert {path: kind for path, (kind, _) in places(found).items()} == {
        "Line/Run": "BOOL", "Line/Mode": "BYTE", "Line/Status": "WORD", "Line/Temp": "REAL",
        "Line/Arr": "ARRAY[0..9] OF INT",
    }  # fmt: skip
    assert left_out(found) == {"Line/Arr0": 11}
    assert found.tags["Line/Arr"]["address"] == 'nsu=http://www.siemens.com/simatic-s7-opcua;s="DB1"."Arr"'
    other = (FIELD / "s7/s7_nodeset.xml").read_bytes().replace(b"simatic-s7-opcua<", b"another<")
    assert set(left_out(import_tags(other))) == {"Line/Mode", "Line/Status", "Line/Arr0"}


def test_types_and_constants_in_further_files() -> None:
    found = imported("s7/ml_udt_elsewhere.xml", "s7/ml_udt_type.xml")
    assert places(found) == {
        "Go": ("BOOL", "%DB20.DBX0.0"), "Axis/On": ("BOOL", "%DB20.DBX2.0"), "Axis/Pos": ("REAL", "%DB20.DBD4"),
        "Axes/1/On": ("BOOL", "%DB20.DBX8.0"), "Axes/1/Pos": ("REAL", "%DB20.DBD10"),
        "Axes/2/On": ("BOOL", "%DB20.DBX14.0"), "Axes/2/Pos": ("REAL", "%DB20.DBD16"),
    }  # fmt: skip
    assert places(imported("s7/ml_udt_type.xml", "s7/ml_udt_elsewhere.xml")) == places(found)
    assert places(imported("s7/ml_udt_elsewhere.xml", "s7/simatic_sd_type.s7dcl")) == places(found)
    assert "unknown type 'AxisData'" in next(iter(imported("s7/ml_udt_elsewhere.xml").skipped))
    assert "'N_LANES'" in next(iter(imported("s7/ml_symbolic_bounds.xml").skipped))
    data = (FIELD / "s7/ml_symbolic_bounds.xml").read_bytes()
    constant = "<SW.Tags.PlcUserConstant><AttributeList><Name>N_LANES</Name><Value>4</Value></AttributeList>"
    for name, text in (
        ("c.scl", "VAR CONSTANT N_LANES : Int := 4; END_VAR"),
        (
            "c.xml",
            f"<Document><SW.Tags.PlcTagTable>{constant}</SW.Tags.PlcUserConstant></SW.Tags.PlcTagTable></Document>",
        ),
        ("c.xml", "<Tagtable name='x'><Constant type='Int' value='4'>N_LANES</Constant></Tagtable>"),
    ):
        found = import_tags(data, further=[Source(name, text.encode())])
        assert places(found) == {"a": ("ARRAY[1..4, 0..2] OF UINT", "%DB23.DBW0"), "b": ("INT", "%DB23.DBW24")}, text


def test_system_types_cost_only_what_cannot_be_placed() -> None:
    timers = ["t/PT", "t/ET", "t/IN", "t/Q", "i/PT", "i/ET", "i/IN", "i/Q", "z"]
    for name in ("s7/ml_ton_member.xml", "s7/ml_ton_optimized.xml"):
        found = imported(name)
        assert list(places(found)) == timers, name
        assert {address for _, address in places(found).values()} == {""}
        assert not any("left out" in line or "leaves" in line for line in found.report())  # it has all members
        layout = compile_sources([Source("any.toml", found.to_toml("x", writable=False).encode())]).layouts[0]
        assert siemens.node_address(layout, layout.registers[0]).identifier == '"Timers"."t"."PT"'
    sized = imported("s7/ml_ton_member.xml", type_bytes={"TON_TIME": 16})
    assert places(sized) == {"z": ("INT", "%DB25.DBW32")}
    assert list(left_out(sized)) == timers[:-1]
    assert list(places(imported("s7/ml_ton_member.xml", type_bytes={"TON_TIME": 16}, by_name=True))) == timers


def test_function_blocks_with_timers_are_read_by_name() -> None:
    compiled = compile_sources([Source("fb_timers.scl", (FIELD / "s7/fb_timers.scl").read_bytes())])
    [layout] = compiled.layouts
    nodes = [siemens.node_address(layout, register).identifier for register in layout.registers]
    assert nodes == [
        f'"Mon_DB".{name}' for name in (
            '"X"', '"TimerTON"."PT"', '"TimerTON"."ET"', '"TimerTON"."IN"', '"TimerTON"."Q"', '"Param"."inv"',
            '"Param"."delay"', '"Param"."prio"', '"CTU"."CU"', '"CTU"."CD"', '"CTU"."R"', '"CTU"."LD"', '"CTU"."QU"',
            '"CTU"."QD"', '"CTU"."PV"', '"CTU"."CV"',
        )
    ]  # fmt: skip
    assert {one.path: one.initial for one in layout.registers}["Param/delay"] == "T#5S"


def test_an_unknown_system_type_costs_the_members_whose_addresses_depend_on_it() -> None:
    text = """
        TYPE "Inner" STRUCT a : Int; t : TON_TIME; b : Int := 3; END_STRUCT END_TYPE
        DATA_BLOCK DB1 STRUCT x : Int; p : "Inner"; y : Int; e : Array[0..1] of "Inner"; END_STRUCT
        BEGIN p.b := 5; p.t.PT := T#1s; y := 7; END_DATA_BLOCK"""
    program = Program([Source("x.db", text.encode())])
    absolute = program.compile()
    assert offsets(absolute.layouts[0]) == {"x": "0", "p/a": "2"}
    [warning] = [one for one in absolute.warnings if "TON_TIME" in one.message]
    left = [str(one) for one in absolute.warnings if "left out, because" in one.message]
    assert left == [
        "x.db:2:52: warning: left out, because their addresses are not known: 'b'",
        "x.db:3:53: warning: left out, because their addresses are not known: 'y', 'e'",
    ]
    assert re.search("no addresses of them, nor of the members after them.*type_bytes.*siemens", warning.message)
    sized = program.compile(type_bytes={"TON_TIME": 16})
    assert offsets(sized.layouts[0]) | {"y": "22"} == offsets(sized.layouts[0])
    named = program.compile(by_name=True)
    assert [one.path for one in named.layouts[0].registers][:8] == [
        "x", "p/a", "p/t/PT", "p/t/ET", "p/t/IN", "p/t/Q", "p/b", "y"
    ]  # fmt: skip
    assert {one.path: one.initial for one in named.layouts[0].registers}["p/b"] == "5"
    other = Program(
        [Source("x.db", b"DATA_BLOCK DB1 STRUCT a : Int; t : TCON; z : Int; END_STRUCT BEGIN END_DATA_BLOCK")]
    )
    assert [one.path for one in other.compile(by_name=True).layouts[0].registers] == ["a", "z"]
    with pytest.raises(LayoutError, match="unknown type 'Nope'"):
        compile_sources([Source("x.db", b"DATA_BLOCK DB1 STRUCT a:Int; t:TON_TIME; z:Nope; END_STRUCT END_DATA_BLOCK")])


def test_simatic_sd() -> None:
    names = ("simatic_sd.s7dcl", "simatic_sd_type.s7dcl")
    [layout] = compile_sources([Source(name, (FIELD / "s7" / name).read_bytes()) for name in names]).layouts
    assert (layout.name, layout.number, layout.optimized) == ("Press_DB", 71, False)
    assert offsets(layout) == {
        "Reset": "0.0", "Limits/Low": "2", "Axis/On": "6.0", "Axis/Pos": "8", "Axes/1/On": "12.0", "Axes/1/Pos": "14",
        "Axes/2/On": "18.0", "Axes/2/Pos": "20",
    }  # fmt: skip


SD = """{
    S7_Author := "";
    S7_BlockComment := "MLC_a";
    S7_BlockNumber := "12";
    S7_Optimized := "FALSE";
    S7_StandardRetain := "FALSE"
}
DATA_BLOCK "Line DB"
    VAR RETAIN
        {
            S7_MLC := "MLC_b";
            S7_Setpoint := "False"
        }
        "ED" : Array[0.._.N_MAX] of _.typeAxis;
        label : String[16] := 'hello';
    END_VAR
    VAR
        retain : Bool; // kept
        cfg : Struct
            a : Int := 3;
            hist : Array[0..2] of DInt;
        END_STRUCT;
        plain : typeAxis;
        quoted : "typeAxis";
        of_unit : Tools."typeAxis";
    END_VAR

    "ED"[0].pos := 1.5;
    { S7_MLC := "MLC_c" }
    "ED"[0] := ();
    cfg.hist := [1, 2, 3];
    label := 'deep';
END_DATA_BLOCK
{
    S7_Optimized := "TRUE"
}
FUNCTION "Calc" : Void
    VAR_INPUT a : Int; END_VAR
    { S7_Language := "SCL" }
    NETWORK
        #a := 'never closed;
    END_NETWORK
END_FUNCTION
{ S7_Optimized := "FALSE"; S7_PreferredLanguage := "LAD" }
FUNCTION_BLOCK "Mover"
    VAR
        n : Int;
    END_VAR
    VAR_INPUT
        { S7_MLC := "MLC_d" }
        start : Bool := TRUE;
    END_VAR
    VAR_TEMP t : Int; END_VAR
    VAR CONSTANT K : Int := 2; END_VAR
    { S7_Language := "LAD" }
    NETWORK
        RUNG wire#powerrail Contact( #start ) END_RUNG
    END_NETWORK
END_FUNCTION_BLOCK
{ S7_BlockNumber := "13"; S7_Optimized := "FALSE" }
DATA_BLOCK MoverDB : Mover
    n := 4;
END_DATA_BLOCK
DATA_BLOCK Plain
    VAR a : Int; END_VAR
END_DATA_BLOCK
TYPE
    { S7_MLC := "MLC_e" }
    typeAxis : STRUCT
        pos : Real;
        on : Bool;
    END_STRUCT;
    typeOther : STRUCT
        x : _.typeAxis;
    END_STRUCT;
END_TYPE
VAR CONSTANT N_MAX : Int := 1; END_VAR
"""


def test_forms_of_simatic_sd() -> None:
    compiled = compile_sources([Source("all.s7dcl", b"\xef\xbb\xbf" + SD.encode())])
    line, mover, plain = compiled.layouts
    assert (line.name, line.number, line.optimized) == ("Line DB", 12, False)
    assert offsets(line) == {
        "ED/0/pos": "0", "ED/0/on": "4.0", "ED/1/pos": "6", "ED/1/on": "10.0", "label": "12", "retain": "30.0",
        "cfg/a": "32", "cfg/hist": "34", "plain/pos": "46", "plain/on": "50.0", "quoted/pos": "52", "quoted/on": "56.0",
        "of_unit/pos": "58", "of_unit/on": "62.0",
    }  # fmt: skip
    initial = {one.path: one.initial for one in line.registers if one.initial}
    assert initial == {"ED/0/pos": "1.5", "label": "'deep'", "cfg/a": "3", "cfg/hist": "[1, 2, 3]"}
    assert (mover.number, offsets(mover)) == (13, {"start": "0.0", "n": "2"})
    assert {one.path: one.initial for one in mover.registers} == {"start": "TRUE", "n": "4"}
    assert plain.optimized  # nothing says that its members have addresses
    torn = SD.replace("label : String[16]", "label String[16]")
    with pytest.raises(LayoutError, match=r"all\.s7dcl:15:21: error: expected ':' and the type"):
        compile_sources([Source("all.s7dcl", torn.encode())])


def test_types_of_software_units() -> None:
    block = (FIELD / "s7/unit_types.db").read_bytes()
    with pytest.raises(LayoutError, match=re.escape("unknown type 'Tools.Axis'")):
        compile_sources([Source("u.db", block)])
    for name in ('"Tools"."Axis"', '"Axis"'):
        given = f"TYPE {name} STRUCT p : Real; END_STRUCT END_TYPE".encode()
        [layout] = compile_sources([Source("u.db", block), Source("t.udt", given)]).layouts
        assert offsets(layout) == {"a/p": "0", "b/0/p": "4", "b/1/p": "8"}
    one = Source("t.udt", b'TYPE "Axis" STRUCT p : Real; END_STRUCT END_TYPE')
    other = Source("o.udt", b'TYPE "Other"."Axis" STRUCT q : Int; END_STRUCT END_TYPE')
    two = Source(
        "x.db", b'DATA_BLOCK "X" STRUCT a : "Tools"."Axis"; b : "Other"."Axis"; END_STRUCT BEGIN END_DATA_BLOCK'
    )
    with pytest.raises(LayoutError, match=r"one type 'Axis' for both 'Tools\.Axis' and 'Other\.Axis'"):
        compile_sources([two, one])
    [layout] = compile_sources([two, one, other]).layouts
    assert offsets(layout) == {"a/p": "0", "b/q": "4"}


def ml(members: str, head: str = "GlobalDB", more: str = "<Number>5</Number>", section: str = "Static") -> str:
    return (
        f'<Document><SW.Blocks.{head}><AttributeList><Interface><Sections><Section Name="{section}">{members}</Section>'
        f"</Sections></Interface><MemoryLayout>Standard</MemoryLayout><Name>B</Name>{more}</AttributeList>"
        f"</SW.Blocks.{head}></Document>"
    )


def test_members_of_simatic_ml() -> None:
    deep = '<Member Name="s" Datatype="Struct">' * 40 + '<Member Name="x" Datatype="Int"/>' + "</Member>" * 40
    cases = {
        '<Member Name="a" Datatype="String[3]"><StartValue>\'on\'</StartValue></Member>': {"a": "on"},
        '<Member Name="a" Datatype="Array[0..2] of Int"><Subelement Path="1"><StartValue>7</StartValue></Subelement>'
        "</Member>": {"a": ["0", "7", "0"]},
        '<Member Name="s" Datatype="Array[1..2] of Struct"><Member Name="a" Datatype="Array[0..1] of Int">'
        '<Subelement Path="2,1"><StartValue>9</StartValue></Subelement></Member></Member>': {
            "s/1/a": None, "s/2/a": ["0", "9"],
        },
        '<Member Name="a" Datatype="Int"><StartValue>"MAX"</StartValue></Member>': {"a": None},
        '<Member Name="a" Datatype="Int"><StartValue>16#5</StartValue></Member>': {"a": "16#5"},
        '<Member Name="a" Datatype="Bool"><StartValue>true</StartValue></Member>': {"a": "true"},
        '<Member Name="a &quot;b&quot;/c" Datatype="Bool"/>': {'a "b"%2Fc': None},
    }  # fmt: skip
    for members, expected in cases.items():
        found = import_tags(ml(members).encode())
        places(found)
        assert {path: entry.get("initial") for path, entry in found.tags.items()} == expected, members
    for members, what in {
        deep: "nested more than 32 deep", '<Member Name="a" Datatype="Foo"/>': "unknown type 'Foo'",
        '<Member Name="a" Datatype="Array[2..1] of Int"/>': "not above the upper",
        '<Member Name="a"/>': "expected a type",
        '<Member Name="" Datatype="Int"/>': "a member has no name",
        '<Member Name="a" Datatype="Int Int"/>': "expected a type",
        '<Member Name="a" Datatype="Struct"/>': "at least one member",
    }.items():  # fmt: skip
        found = import_tags(ml(members).encode())
        assert list(left_out(found)) == ["B"], members
        assert what in next(iter(found.skipped)), members


def test_an_instance_without_its_interface_needs_the_function_block() -> None:
    empty = ml("", "InstanceDB", "<Number>7</Number><InstanceOfName>Mover</InstanceOfName>")
    block = ml('<Member Name="go" Datatype="Bool"/>', "FB", "<Number>1</Number>", "Input").replace(">B<", ">Mover<")
    assert "unknown type 'Mover'" in next(iter(import_tags(empty.encode()).skipped))
    found = import_tags(empty.encode(), further=[Source("Mover.xml", block.encode())])
    assert places(found) == {"go": ("BOOL", "%DB7.DBX0.0")}
    optimized = block.replace(">Standard<", ">Optimized<")
    found = import_tags(empty.encode(), further=[Source("Mover.xml", optimized.encode())])
    assert places(found) == {"go": ("BOOL", "")}


def test_other_programs_are_refused_by_their_names(tmp_path: Path) -> None:
    for name, data, what in (
        ("b.awl", (FIELD / "s7/microwin.awl").read_bytes(), "STEP 7-Micro/WIN"),
        ("b.mc7", b"pp\x01\x01\x02\x0a\x00\x05\x00\x00" + bytes(60), "MC7"),
        ("b.txt", b"00000000: 7070 0101 020a 0005 0000 0120\n", "MC7"),
        ("b.awl", b"DATA_BLOCK\n//DATA PAGE COMMENTS\n//\nEND_DATA_BLOCK\n", "STEP 7-Micro/WIN"),
        ("b.txt", b"70 70 01 01 02 0a 00 05 00 00 01 20 00\n", "MC7"),
        (
            "b.awl",
            b'DATA_BLOCK "\xcb\xae\xb1\xc3\xd4\xcb\xd0\xd0" STRUCT \xc8\xed : Int; END_STRUCT END_DATA_BLOCK',
            "GBK",
        ),
    ):
        with pytest.raises(LayoutError, match=what):
            compile_sources([Source(name, data)])
    gbk = 'DATA_BLOCK "水泵运行" STRUCT "软" : Int; END_STRUCT END_DATA_BLOCK'.encode("gbk")
    assert compile_sources([Source("b.awl", gbk, "gbk")]).layouts[0].name == "水泵运行"
    file = tmp_path / "b.awl"
    file.write_bytes(gbk)
    assert main(["--encoding", "gbk", str(file)]) == 0


def test_the_named_command_reads_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    files = [file for folder in ("s7", "protocols") for file in (FIELD / folder).glob("*.*")]
    for file in files:
        if file.suffix not in (".xml", ".csv", ".sdf"):
            continue
        assert main([str(file)]) == 1
        message = capsys.readouterr().err
        try:
            import_tags(file.read_bytes())
            reads = True
        except ImportingError:
            reads = False
        assert ("shmio-layout import" in message) == reads, (file.name, message)
        capsys.readouterr()


def test_the_command_names_every_row_it_left_out(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    rows = "".join(f'"r{n}","{n}x",Word,1,R/W,100,,,,,,,,,,,\n' for n in range(40))
    (tmp_path / "k.csv").write_text(f'{KEP}{rows}"ok","400001",Word,1,R/W,100,,,,,,,,,,,\n')
    assert main(["import", str(tmp_path / "k.csv")]) == 0
    report = capsys.readouterr().err
    assert all(f"r{n} (line {n + 2})" in report for n in range(40))


def test_what_an_importer_leaves_out_has_its_line() -> None:
    book = openpyxl.Workbook()
    page = book.active
    assert page is not None
    page.title = "PLC Tags"
    for row in (
        ["Name", "Data Type", "Logical Address", "Comment"], ["a", "Bool", "%M0.0", "x"],
        ["b", "Bool", "%M0.1", datetime.date(2024, 1, 1)], [None, "Bool", "%M0.2", ""], ["d", '"T"', "%M2.0", ""],
    ):  # fmt: skip
        page.append(row)
    book.save(buffer := io.BytesIO())
    found = import_tags(buffer.getvalue())
    assert (list(found.tags), left_out(found)) == (["a"], {"a row": 4, "d": 5})
    assert "cell D3 is a date or a time" in next(iter(found.skipped))
    nodes = (
        '<UANodeSet>\n<UAVariable NodeId="i=1" BrowseName="a" DataType="i=1"/>\n<UAVariable BrowseName="b"/>\n'
        '<UAVariable NodeId="i=1" BrowseName="c" DataType="i=1"/>\n'
        '<UAVariable NodeId="i=2" BrowseName="d" DataType="i=1" ValueRank="2" ArrayDimensions="3"/></UANodeSet>'
    )
    found = import_tags(nodes.encode())
    assert (list(found.tags), left_out(found)) == (["a"], {"b": 3, "c": 4, "d": 5})
    table = (
        "<Tagtables><Tagtable><Tag type='Bool' addr=''>a</Tag>\n<Tag type='Bool' addr='%M0.0'>b</Tag>\n"
        "<Foo>c</Foo></Tagtable></Tagtables>"
    )
    found = import_tags(table.encode())
    assert (list(found.tags), left_out(found)) == (["b"], {"a": 1, "c": 3})
    both = ml("", "ArrayDB").removesuffix("</Document>") + ml('<Member Name="a" Datatype="Int"/>')[10:]
    found = import_tags(both.encode())
    assert (list(found.tags), left_out(found)) == (["a"], {"B": 1})


def test_an_instance_of_a_system_type_has_no_addresses() -> None:
    members = "".join(f'<Member Name="{name}" Datatype="{kind}"/>' for name, kind in (("PT", "Time"), ("Q", "Bool")))
    more = "<Number>7</Number><InstanceOfName>IEC_TIMER</InstanceOfName>"
    found = import_tags(ml(members, "InstanceDB", more).encode())
    assert places(found) == {"PT": ("TIME", ""), "Q": ("BOOL", "")}


def test_options_that_do_not_suit_a_list_are_refused() -> None:
    with pytest.raises(ImportingError, match="data blocks in XML of TIA Portal Openness"):
        imported("s7/kep_s7.csv", "s7/ml_udt_type.xml")
    for options in ({"type_bytes": {"T": 2}}, {"by_name": True}):
        with pytest.raises(ImportingError, match="data blocks in XML of TIA Portal Openness"):
            imported("s7/kep_s7.csv", **options)
    assert "'Nope'" in imported("s7/ml_dtl.xml", type_bytes={"Nope": 2}).remarks[0]
    with pytest.raises(ImportingError, match="needs no import"):
        imported("s7/simatic_sd.s7dcl")


def test_files_beside_sources_of_simatic_sd_are_named() -> None:
    with pytest.raises(LayoutError, match=r"texts of a source in SIMATIC SD \(\.s7res\)"):
        compile_sources([Source("a.s7res", b"MultiLingualTexts:\n  - id: MLC_a\n    en-US: text\n")])
    header = b"(*\nV1 initial version\n*)\nDATA_BLOCK DB1 STRUCT a : Int; END_STRUCT BEGIN END_DATA_BLOCK"
    assert compile_sources([Source("a.awl", header)]).layouts[0].registers[0].path == "a"


def test_the_remedies_of_a_skipped_tag_work() -> None:
    ton = b'TYPE "TON_TIME"\nSTRUCT\nPT : Time;\nET : Time;\n"IN" : Bool;\nQ : Bool;\nEND_STRUCT;\nEND_TYPE\n'
    data = (FIELD / "s7/ml_ton_member.xml").read_bytes()
    declared = import_tags(data, further=[Source("ton.udt", ton)])
    assert places(declared)["t/Q"] == ("BOOL", "%DB25.DBX8.1")
    sized = import_tags(data, type_bytes={"TON_TIME": 10})
    assert places(sized) == {"z": ("INT", "%DB25.DBW26")}
    for found, members in ((declared, "i"), (sized, "ti")):
        [(why, skipped)] = found.skipped.items()
        assert [name for name, _ in skipped] == [f"{one}/{name}" for one in members for name in ("PT", "ET", "IN", "Q")]
        assert "PLC data type" in why
        assert "--by-name" in why
        assert "--type-bytes" not in why  # no size is missing
    assert {*import_tags(data, by_name=True).tags} == {*declared.tags, "i/PT", "i/ET", "i/IN", "i/Q"}


def test_reasons_are_short_and_name_what_is_missing() -> None:
    found = import_tags(b"Name;Type;Address\na;Bool;%I0.0\nk;Int;\nlong;Int;" + b"M" * 100_000)
    assert {name: len(why) <= 1000 for why, items in found.skipped.items() for name, _ in items} == {
        "k": True, "long": True,
    }  # fmt: skip
    assert ("k", 3) in found.skipped["the tag has no address"]


def test_no_message_recommends_the_import_of_a_file_that_has_only_constants() -> None:
    data = (
        b"<Document><SW.Tags.PlcTagTable><ObjectList><SW.Tags.PlcUserConstant><AttributeList><Name>N</Name>"
        b"<Value>3</Value></AttributeList></SW.Tags.PlcUserConstant></ObjectList></SW.Tags.PlcTagTable></Document>"
    )
    assert not import_tags(data).tags
    assert "this is XML" in foreign("c.xml", data)
    assert "import" not in foreign("c.xml", data)
    tags = data.replace(b"PlcUserConstant", b"PlcTag").replace(b"<Value>3", b"<DataTypeName>Int</DataTypeName><Value>3")
    assert "shmio-layout import" in foreign("c.xml", tags)


def test_settings_that_an_export_of_kepserverex_lacks_are_named() -> None:
    """Manual "Modbus Ethernet", settings of a device."""
    for address, data_type, wanted in (
        ("400001", "Word", 0), ("400001.3", "Boolean", 1), ("400001", "Float", 1), ("000001", "Boolean", 0),
        ("DB5,X0.3", "Boolean", 0),
    ):  # fmt: skip
        assert len(kep(address, data_type).remarks) == wanted, address
    assert "numbers are from 1 to 16" in kep("400001.3", "Boolean").remarks[0]


def test_a_tag_of_a_plc_data_type_in_a_list_is_named_as_such() -> None:
    for row in ('"u","%I4.0","""Axis""","True","True","False","","","False"', 'u;"""Axis""";%I4.0'):
        header = "Name;Type;Address\n" if ";" in row else ""
        found = import_tags((header + row + "\n").encode())
        assert [(why[:15], len(items)) for why, items in found.skipped.items()] == [("a PLC data type", 1)]


def test_tags_of_tia_portal_v13() -> None:
    """Their names are others, and a link has the type."""
    data = (
        b"<Document><SW.ControllerTagTable><ObjectList><SW.ControllerTag><AttributeList><LogicalAddress>%I0.3"
        b"</LogicalAddress><Name>Guard</Name></AttributeList><LinkList><DataType TargetID='@OpenLink'><Name>Bool</Name>"
        b"</DataType></LinkList></SW.ControllerTag></ObjectList></SW.ControllerTagTable></Document>"
    )
    for text in (data, data.replace(b"SW.Controller", b"SW.Tags.Plc")):
        assert places(import_tags(text)) == {"Guard": ("Bool", "%I0.3")}
        assert "shmio-layout import" in foreign("x.xml", text)


def test_inputs_that_cannot_be_written_are_reported_only_if_others_become_writable() -> None:
    keys = {"ExternalWritable": "true", "DataTypeName": "Bool", "LogicalAddress": "%I0.0", "Name": "i"}
    attributes = "".join(f"<{key}>{value}</{key}>" for key, value in keys.items())
    tag = f"<SW.Tags.PlcTag><AttributeList>{attributes}</AttributeList></SW.Tags.PlcTag>"
    found = import_tags(f"<Document><SW.Tags.PlcTagTable>{tag}</SW.Tags.PlcTagTable></Document>".encode())
    told = "not writable: 1 tag, because there are inputs at their addresses"
    assert [told in found.report(writable=writable) for writable in (True, False)] == [True, False]


def test_types_that_only_the_project_knows_are_named_as_such_in_tag_lists() -> None:
    for kind in ("UDT 5", "Widget", "Point"):
        found = import_tags(f'"a","M 10.0","{kind}",""\n"b","M 12.0","BOOL",""\n'.encode())
        assert [*found.tags] == ["b"]
        assert [*found.skipped] == [f"unknown type '{kind}'; if it is a PLC data type, name its members in the table"]
