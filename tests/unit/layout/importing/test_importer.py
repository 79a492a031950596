"""Importers read files as the vendors' tools write them, and report what they leave out."""

from __future__ import annotations

import io
import tomllib
from contextlib import suppress
from pathlib import Path

import openpyxl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.cli.layout import main
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.importing.importer import import_tags
from shmio.layout.s7.notation import from_classic


def tia_workbook() -> bytes:
    """Return a workbook with the sheets and columns of TIA Portal's export of all PLC tags."""
    book = openpyxl.Workbook()
    page = book.active
    assert page is not None
    page.title = "PLC Tags"
    page.append(
        ["Name", "Path", "Data Type", "Logical Address", "Comment", "Hmi Visible", "Hmi Accessible", "Hmi Writeable",
         "Typeobject ID", "Version ID"]
    )  # fmt: skip
    for name, kind, address, comment, writable in [
        ("Motor.Speed", "Int", "%IW64", "actual speed", "False"),
        ("Door/Closed", "Bool", "%I0.0", "<No Value>", "True"),
        ("Level", "Real", "%MD100", "", "True"),
        ("Wait", "Timer", "%T3", "", "True"),
        ("Axis", '"AxisData"', "%M200.0", "", "True"),
        ("level", "Widget", "%MD104", "", "True"),
    ]:
        page.append([name, "Cell\\Inputs", kind, address, comment, "True", "True", writable, None, None])
    constants = book.create_sheet("Constants")
    constants.append(["Name", "Path", "Data Type", "Value", "Comment"])
    book.create_sheet("TagTable Properties").append(["Path", "BelongsToUnit", "Accessibility"])
    book.save(buffer := io.BytesIO())
    return buffer.getvalue()


SDF = (
    '"green_ped               ","T      2   ","TIMER     ","Green for pedestrians"\r\n'
    '"red_ped                 ","A      0.0 ","BOOL      ","Rot für Fußgänger"\r\n'
    '"Analog_1                ","PEW  256   ","WORD      ",""\r\n'
    '"Data                    ","DB     5   ","DB     5  ","a block"\r\n'
    '"Main                    ","OB     1   ","OB     1  ",""\r\n'
)


def asc(*symbols: tuple[str, str, str, str]) -> bytes:
    return "".join(f"126,{n:24}{a:12}{t:10}{c:80}\r\n" for n, a, t, c in symbols).encode("cp1252")


KEP = (
    "Tag Name,Address,Data Type,Respect Data Type,Client Access,Scan Rate,Scaling,Raw Low,Raw High,Scaled Low,"
    "Scaled High,Scaled Data Type,Clamp Low,Clamp High,Eng Units,Description,Negate Value\r\n"
    '"Pump.Speed","400001",Word,1,R/W,100,Linear,0,1000,-50,50,Float,0,0,"1/min","the speed",0\r\n'
    '"Pump.Running","000001",Boolean,1,RO,100,,,,,,,,,,"",\r\n'
    '"Curve","400010 [5]",Float Array,1,R/W,100,,,,,,,,,,"",\r\n'
    '"When","400100",Date,1,RO,100,,,,,,,,,,"",\r\n'
    '"Flow","400200",Word,1,RO,100,Square Root,0,10,0,10,Double,0,0,"","",0\r\n'
)
TAG_XML = """<?xml version="1.0" encoding="utf-8"?>
<Document>
  <Engineering version="V18" />
  <SW.Tags.PlcTagTable ID="0">
    <AttributeList><Name>Inputs</Name></AttributeList>
    <ObjectList>
      <SW.Tags.PlcUserConstant ID="1" CompositionName="UserConstants">
        <AttributeList><DataTypeName>Int</DataTypeName><Name>MAX</Name><Value>5</Value></AttributeList>
      </SW.Tags.PlcUserConstant>
      <SW.Tags.PlcTag ID="2" CompositionName="Tags">
        <AttributeList>
          <DataTypeName>Bool</DataTypeName>
          <ExternalAccessible>true</ExternalAccessible>
          <ExternalVisible>true</ExternalVisible>
          <ExternalWritable>true</ExternalWritable>
          <LogicalAddress>%I0.0</LogicalAddress>
          <Name>DoorClosed</Name>
        </AttributeList>
        <ObjectList>
          <MultilingualText ID="3" CompositionName="Comment">
            <ObjectList>
              <MultilingualTextItem ID="4" CompositionName="Items">
                <AttributeList><Culture>en-US</Culture><Text>the door &amp; its lock</Text></AttributeList>
              </MultilingualTextItem>
            </ObjectList>
          </MultilingualText>
        </ObjectList>
      </SW.Tags.PlcTag>
    </ObjectList>
  </SW.Tags.PlcTagTable>
</Document>
"""
DB_XML = """<?xml version="1.0" encoding="utf-8"?>
<Document>
  <Engineering version="V18" />
  <SW.Blocks.GlobalDB ID="0">
    <AttributeList>
      <Interface><Sections xmlns="http://www.siemens.com/automation/Openness/SW/Interface/v5">
  <Section Name="Static">
    <Member Name="Speed set" Datatype="Int" Remanence="NonRetain" Accessibility="Public">
      <AttributeList>
        <BooleanAttribute Name="ExternalAccessible" SystemDefined="true">true</BooleanAttribute>
      </AttributeList>
      <Comment><MultiLanguageText Lang="en-US">the
 set point</MultiLanguageText></Comment>
      <StartValue>16#5</StartValue>
    </Member>
    <Member Name="Bits" Datatype="Array[0..9] of Bool" />
    <Member Name="Axis" Datatype="Array[1..2] of &quot;AxisData&quot;">
      <Sections><Section Name="None">
        <Member Name="Pos" Datatype="Real"><StartValue>1.5</StartValue></Member>
        <Member Name="On" Datatype="Bool" />
      </Section></Sections>
    </Member>
    <Member Name="Lamp" Datatype="Struct">
      <Member Name="Text" Datatype="String[10]"><StartValue>'on'</StartValue></Member>
      <Member Name="Long" Datatype="LReal" />
    </Member>
  </Section>
</Sections></Interface>
      <MemoryLayout>Standard</MemoryLayout>
      <Name>Cell</Name>
      <Number>5</Number>
      <ProgrammingLanguage>DB</ProgrammingLanguage>
    </AttributeList>
  </SW.Blocks.GlobalDB>
</Document>
"""
NODES = """<?xml version="1.0" encoding="utf-8"?>
<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd"
           xmlns:uax="http://opcfoundation.org/UA/2008/02/Types.xsd">
  <NamespaceUris><Uri>http://example.org/pump;1</Uri></NamespaceUris>
  <Aliases>
    <Alias Alias="Boolean">i=1</Alias><Alias Alias="Double">i=11</Alias><Alias Alias="HasComponent">i=47</Alias>
    <Alias Alias="Organizes">i=35</Alias><Alias Alias="HasProperty">i=46</Alias>
  </Aliases>
  <UADataType NodeId="ns=1;i=3001" BrowseName="1:Mode">
    <References><Reference ReferenceType="HasSubtype" IsForward="false">i=29</Reference></References>
  </UADataType>
  <UAObjectType NodeId="ns=1;i=1001" BrowseName="1:PumpType" />
  <UAVariable NodeId="ns=1;i=1002" BrowseName="1:Speed" ParentNodeId="ns=1;i=1001" DataType="Double" />
  <UAObject NodeId="ns=1;i=5001" BrowseName="1:Pump">
    <References><Reference ReferenceType="Organizes" IsForward="false">i=85</Reference></References>
  </UAObject>
  <UAVariable NodeId="ns=1;s=Pump.Speed" BrowseName="1:Speed" ParentNodeId="ns=1;i=5001" DataType="Double"
              AccessLevel="3">
    <Description>actual speed</Description>
    <References><Reference ReferenceType="HasComponent" IsForward="false">ns=1;i=5001</Reference></References>
  </UAVariable>
  <UAVariable NodeId="ns=1;i=6002" BrowseName="EngineeringUnits" ParentNodeId="ns=1;s=Pump.Speed" DataType="i=887">
    <References><Reference ReferenceType="HasProperty" IsForward="false">ns=1;s=Pump.Speed</Reference></References>
    <Value><uax:ExtensionObject><uax:Body><uax:EUInformation>
      <uax:DisplayName><uax:Text>rpm</uax:Text></uax:DisplayName>
    </uax:EUInformation></uax:Body></uax:ExtensionObject></Value>
  </UAVariable>
  <UAVariable NodeId="ns=1;i=6003" BrowseName="1:Mode" ParentNodeId="ns=1;i=5001" DataType="ns=1;i=3001" />
  <UAVariable NodeId="ns=1;i=6004" BrowseName="1:Curve" ParentNodeId="ns=1;i=5001" DataType="Double" ValueRank="1"
              ArrayDimensions="5" />
  <UAVariable NodeId="ns=1;i=6005" BrowseName="1:Open" ParentNodeId="ns=1;i=5001" DataType="Double" ValueRank="1" />
  <UAMethod NodeId="ns=1;i=7001" BrowseName="1:Start" ParentNodeId="ns=1;i=5001" />
  <UAVariable NodeId="ns=1;i=7002" BrowseName="InputArguments" ParentNodeId="ns=1;i=7001" DataType="i=296" />
  <UAVariable NodeId="ns=1;i=8001" BrowseName="1:A" ParentNodeId="ns=1;i=8002" DataType="Boolean" />
  <UAVariable NodeId="ns=1;i=8002" BrowseName="1:B" ParentNodeId="ns=1;i=8001" DataType="Boolean" />
</UANodeSet>
"""


def summary(found: Found) -> list[tuple[object, ...]]:
    """Check that the table compiles, and return path, type and address of each register."""
    layout = compile_sources([Source("x.toml", found.to_toml("x", writable=True).encode())]).layouts[0]
    assert [register.path for register in layout.registers] == list(found.tags)
    return [(path, entry["type"], entry.get("address", "")) for path, entry in found.tags.items()]


def reasons(found: Found) -> dict[str, list[str]]:
    return {why.partition(";")[0]: [name for name, _ in items] for why, items in found.skipped.items()}


def test_a_workbook_of_tia_portal() -> None:
    found = import_tags(tia_workbook())
    assert summary(found) == [
        ("Motor.Speed", "Int", "%IW64"),
        ("Door%2FClosed", "Bool", "%I0.0"),
        ("Level", "Real", "%MD100"),
        ("Wait", "S5TIME", "%T3"),
    ]
    assert found.tags["Motor.Speed"] == {"type": "Int", "address": "%IW64", "comment": "actual speed"}
    assert found.tags["Door%2FClosed"] == {"type": "Bool", "address": "%I0.0"}  # inputs cannot be written
    assert found.tags["Level"] == {"type": "Real", "address": "%MD100", "writable": True}
    assert reasons(found) == {"a PLC data type": ["Axis"], "unknown type 'Widget'": ["level"]}


def test_a_symbol_table_of_step_7_as_sdf() -> None:
    found = import_tags(SDF.encode("cp1252"))
    assert summary(found) == [
        ("green_ped", "S5TIME", "%T2"), ("red_ped", "BOOL", "%Q0.0"), ("Analog_1", "WORD", "%IW256:P")
    ]  # fmt: skip
    assert found.tags["red_ped"]["comment"] == "Rot für Fußgänger"
    assert list(reasons(found).values()) == [["Data", "Main"]]


def test_a_symbol_table_of_step_7_as_asc_and_seq_and_csv() -> None:
    found = import_tags(asc(("red ped", "Q      0.0", "BOOL", "Größe"), ("Main", "OB     1", "OB     1", "")))
    assert summary(found) == [("red ped", "BOOL", "%Q0.0")]
    assert found.tags["red ped"]["comment"] == "Größe"
    assert summary(import_tags(b"\tT 2\tgreen\tlong\r\n\tQ 0.0\tred\tshort\r\n\tMW 10\tw\r\n")) == [
        ("green", "S5TIME", "%T2"), ("red", "BOOL", "%Q0.0"), ("w", "WORD", "%MW10")
    ]  # fmt: skip
    assert summary(import_tags(b"speed; MW 10; INT; actual\r\n")) == [("speed", "INT", "%MW10")]


@pytest.mark.parametrize(
    ("classic", "address"),
    [
        ("E   0.7", "%I0.7"), ("AB 5", "%QB5"), ("MD 100", "%MD100"), ("Z 3", "%C3"), ("PAW 2", "%QW2:P"),
        ("DB 5.DBX 0.1", "%DB5.DBX0.1"), ("DB5.DBW 4", "%DB5.DBW4"), ("I 0.8", None), ("I 4", None), ("IW 4.0", None),
        ("DB5.DBX4", None), ("DB5.DBW4.1", None), ("FC 1", None), ("", None), ("PM 1", None),
    ],
)  # fmt: skip
def test_classic_addresses(classic: str, address: str | None) -> None:
    assert from_classic(classic) == address


def test_tags_of_kepserver() -> None:
    found = import_tags(KEP.encode())
    assert summary(found) == [
        ("Pump/Speed", "REAL", "400001 UINT"), ("Pump/Running", "BOOL", "000001"),
        ("Curve", "ARRAY[0..4] OF REAL", "400010")
    ]  # fmt: skip
    assert found.tags["Pump/Speed"] == {
        "type": "REAL", "address": "400001 UINT", "unit": "1/min", "comment": "the speed", "scale": [0.1, -50.0],
        "writable": True,
    }  # fmt: skip
    assert reasons(found) == {
        "the type 'Date' has no counterpart": ["When"], "the scaling 'Square Root' is not linear": ["Flow"]
    }  # fmt: skip


def test_a_tag_table_of_tia_portal_openness() -> None:
    found = import_tags(TAG_XML.encode("utf-8-sig"))
    assert summary(found) == [("DoorClosed", "Bool", "%I0.0")]
    assert found.tags["DoorClosed"]["comment"] == "the door & its lock"
    assert reasons(found) == {"a constant has no value in the controller": ["MAX"]}


def test_a_data_block_of_tia_portal_openness() -> None:
    found = import_tags(DB_XML.encode())
    assert summary(found) == [
        ("Speed set", "INT", "%DB5.DBW0"),
        ("Bits", "ARRAY[0..9] OF BOOL", "%DB5.DBX2.0"),
        ("Axis/1/Pos", "REAL", "%DB5.DBD4"),
        ("Axis/1/On", "BOOL", "%DB5.DBX8.0"),
        ("Axis/2/Pos", "REAL", "%DB5.DBD10"),
        ("Axis/2/On", "BOOL", "%DB5.DBX14.0"),
        ("Lamp/Text", "STRING[10]", "%DB5.DBX16.0"),
        ("Lamp/Long", "LREAL", "%DB5.DBX28.0"),
    ]
    assert found.tags["Speed set"] == {
        "type": "INT", "address": "%DB5.DBW0", "comment": "the set point", "initial": "16#5"
    }  # fmt: skip
    optimized = import_tags(DB_XML.replace(">Standard<", ">Optimized<").encode())
    assert {address for _, _, address in summary(optimized)} == {""}
    assert "Cell has optimized access" in optimized.remarks[0]


def test_a_data_block_with_a_type_of_unknown_members_is_refused() -> None:
    text = DB_XML.replace('Datatype="LReal"', 'Datatype="&quot;Other&quot;"')
    found = import_tags(text.encode())
    assert not found.tags
    assert reasons(found) == {"the data block cannot be placed: the file:25:1: error: unknown type 'Other'": ["Cell"]}


def test_variables_of_a_node_set() -> None:
    found = import_tags(NODES.encode())
    uri = "nsu=http://example.org/pump%3B1;"
    assert summary(found) == [
        ("Pump/Speed", "LREAL", f"{uri}s=Pump.Speed"),
        ("Pump/Mode", "DINT", f"{uri}i=6003"),
        ("Pump/Curve", "ARRAY[0..4] OF LREAL", f"{uri}i=6004"),
    ]
    assert found.tags["Pump/Speed"] | {"address": ""} == {
        "type": "LREAL", "address": "", "unit": "rpm", "comment": "actual speed", "writable": True
    }  # fmt: skip
    assert set(reasons(found)) == {
        "part of a type, not of an object", "the type i=887 has no counterpart", "an array without fixed lengths",
        "an argument of a method", "its references form a loop",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"", "the format is unknown"),
        (b"hello\n", "the format is unknown"),
        (b"PK\x03\x04", "not a workbook"),
        (b"<a/>", "XML with the root 'a'"),
        (b"<Document><SW.Blocks.FC/></Document>", "expected a PLC tag table or a data block, found SW"),
        (b"<UANodeSet/>", "expected nodes below UANodeSet"),
        (b"<UANodeSet>", "the file is not valid XML"),
        (b'<!DOCTYPE x [<!ENTITY a "b">]><UANodeSet>&a;</UANodeSet>', "declares a document type, which is not allowed"),
        (b'<!DOCTYPE x SYSTEM "file:///etc/passwd"><UANodeSet/>', "declares a document type, which is not allowed"),
        (b"<a>" * 201, "200 deep"),
        (b"<a>" + b"<b/>" * 500_000, "more than 500000 elements"),
        (b"Tag Name,Address\r\n", "does not have the columns data type"),
        (b'"a","b"\r\n', "the format is unknown"),
        (bytes((32 << 20) + 1), "larger than"),
    ],
    ids=lambda given: given[:20] if isinstance(given, bytes) else "",
)  # fmt: skip
def test_other_files_are_refused_with_the_reason(data: bytes, what: str) -> None:
    with pytest.raises(ImportingError) as error:
        import_tags(data)
    assert what in str(error.value)


def test_doubles_and_groups_are_left_out() -> None:
    rows = "".join(
        f'"{name}","400001",Word,1,RO,100,,,,,,,,,,"",\r\n' for name in ("a.b", "a", "a.b", "a.b.c", "x\x01")
    )
    found = import_tags((KEP.partition("\n")[0] + "\n" + rows).encode())
    assert list(found.tags) == ["a/b"]
    assert sorted(name for items in found.skipped.values() for name, _ in items) == ["a", "a/b", "a/b/c", "x\x01"]


def test_the_command_writes_a_table_and_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, table = tmp_path / "kep.csv", tmp_path / "tags.toml"
    file.write_text(KEP)
    assert main(["import", str(file), "-o", str(table)]) == 0
    report = capsys.readouterr().err
    assert "imported 3 tags from tags of KEPServerEX" in report
    assert "skipped 1: the type 'Date' has no counterpart: When (line 5)" in report
    assert "writable" not in table.read_text()
    assert len(tomllib.loads(table.read_text())["registers"]) == 3
    assert main([str(table)]) == 0
    assert main(["import", str(file), "-o", str(table)]) == 1
    assert "exists already" in capsys.readouterr().err
    assert main(["import", "--writable", str(file)]) == 0
    assert tomllib.loads(capsys.readouterr().out)["registers"]["Pump/Speed"]["writable"] is True
    assert main(["import", str(file), "-o", "tags.csv"]) == 1
    assert main(["import", str(tmp_path / "none")]) == 1


FIELD = Path(__file__).parents[3] / "field"
FURTHER = [Source(name, (FIELD / "s7" / name).read_bytes()) for name in ("ml_udt_type.xml", "simatic_sd_type.s7dcl")]
SAMPLES = [tia_workbook(), SDF.encode("cp1252"), KEP.encode(), TAG_XML.encode(), DB_XML.encode(), NODES.encode()]
SAMPLES += [path.read_bytes() for path in sorted(FIELD.glob("*/*")) if path.suffix in (".xml", ".sdf", ".csv")]


@given(
    st.sampled_from(SAMPLES),
    st.lists(st.tuples(st.integers(0, 8000), st.integers(0, 20), st.binary(max_size=20)), min_size=1, max_size=4),
)
def test_any_damage_gives_a_table_that_compiles_or_a_reason(
    sample: bytes, changes: list[tuple[int, int, bytes]]
) -> None:
    for place, removed, inserted in changes:
        at = place % len(sample)
        sample = sample[:at] + inserted + sample[at + removed :]
    with suppress(ImportingError):
        found = import_tags(sample)
        if found.tags:
            summary(found)


@given(
    st.sampled_from([b"<UANodeSet>", b"<Document>", b"126,", b'"', b"Tag Name,Address,Data Type\n", b"\t"]), st.binary()
)
def test_any_bytes_give_a_table_or_a_reason(head: bytes, rest: bytes) -> None:
    with suppress(ImportingError):
        import_tags(head + rest)
