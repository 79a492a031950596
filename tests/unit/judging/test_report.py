"""Reports: what they contain, and that no text of a campaign can break out of them."""

from __future__ import annotations

import dataclasses
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np
import pytest

from shmio.config import Declaration
from shmio.judging.report import Drawn, Report, Span, html, junit
from shmio.judging.source import Rows
from shmio.judging.trace import MAX_POINTS, Plot, Traces
from tests.unit.judging.test_judge import UP, S, expect
from tests.unit.judging.traces import judge

HOSTILE = "</td><script>alert(1)</script>\x01\x1b]\ud800&amp;\"'"


@pytest.fixture
def report() -> Report:
    found = judge(
        expect(never="x > 3", text=HOSTILE, requirement=HOSTILE, name="falls"),
        expect(when="on", within_s=9, then="x > 9", name="open"),
        expect(always="x < 9", name="fine", severity="critical"),
    )
    traces = Traces({"cell": found.signals("cell")}, found.signals("cell"))
    found.add("cell", UP)
    traces.add(found.turn())
    traces.add(found.finish())
    drawn = [[Drawn(one, traces.plot(one), found.troubles("cell")) for one in found.read_by(at)] for at in range(3)]
    return Report(
        f"Campaign {HOSTILE}", [("seed", "7"), (HOSTILE, HOSTILE)], f"shmio-campaign {HOSTILE}", 0, 5 * S + 1,
        found.verdicts, drawn, [Span(HOSTILE, "cell", S, 2 * S), Span("open", "cell", 3 * S, None)],
        [
            Declaration(HOSTILE, HOSTILE, "offset", value=HOSTILE.replace("\ud800", ""), when="on", seed=7),
            Declaration("idle", ["cell/x", "cell/y"], "freeze"),
        ],
    )  # fmt: skip


class Tags(HTMLParser):
    """Collects tags and texts, and what may load something."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.texts: list[str] = []
        self.loading: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.loading += [f"{name}={value}" for name, value in attrs if name in ("src", "href", "data", "style")]

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_page_is_self_contained_and_has_all(report: Report) -> None:
    page = html(report)
    tags = Tags()
    tags.feed(page)
    assert "script" not in tags.tags
    assert set(tags.loading) == {"href=#e0", "href=#e1", "href=#e2"}
    text = " ".join(tags.texts)
    for part in ("1 passed", "1 failed", "1 inconclusive", "failed at 4.000 s", "cell/x", "4.000 s: 4", "alert(1)"):
        assert part in text
    assert page.count("<svg") == 4
    paths = re.findall(r'<path d="([^"]*)" fill="none" stroke="#1f6feb"', page)
    assert all(path.startswith("M70.0 ") for path in paths)
    assert paths[0].count("H") == 6, "six steps"
    page.encode("utf-8", "replace")


def test_injections_are_listed(report: Report) -> None:
    page = html(report)
    table = page.partition("<h2>Injections</h2>")[2].partition("</table>")[0]
    first, second, third = re.findall(r"<tr><td>(.*)</tr>", table.replace("\n", " "), re.DOTALL)[0].split(
        "</tr> <tr><td>"
    )
    assert "<td>offset<td>" in first
    assert first.endswith("<td>7<td>1.000 s to 2.000 s")
    assert "when = " in first
    assert second == "idle<td><code>cell/x</code><br><code>cell/y</code><td>freeze<td><pre></pre><td><td>never"
    assert third == "open<td>cell<td><td><td><td>3.000 s to the end", "an injection that the campaign does not have"
    many = [Span("many", "cell", at * S, at * S + 1) for at in range(30)]
    assert "<br>and 10 more times</tr>" in html(dataclasses.replace(report, injections=many, declared=()))
    assert "Injections" not in html(dataclasses.replace(report, injections=(), declared=()))


def test_junit(report: Report) -> None:
    suite = ET.fromstring(junit(report))
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors"), suite.get("time")) == (
        "3",
        "1",
        "1",
        "5.000",
    )
    first, second, third = suite.iter("testcase")
    assert [child.tag for child in first] == ["properties", "failure"]
    assert "x > 3 was true at 4.000 s" in (first[1].get("message") or "")
    assert "4.000 s: 4" in (first[1].text or "")
    assert [child.tag for child in second] == ["properties", "error"]
    assert [child.tag for child in third] == ["properties"]
    assert {one.get("name"): one.get("value") for one in third[0]} == {"severity": "critical", "robustness": "4.0"}


def test_plots_of_long_signals_keep_extrema_within_a_limit() -> None:
    found = judge(expect(always="y + x < 1"))
    traces = Traces({"cell": found.signals("cell")}, {found.signals("cell")[1]})
    random = np.random.default_rng(1)
    values = random.normal(0, 1, 50_000)
    values[31_337] = 99
    at = 0
    while at < len(values):
        count = int(random.integers(1, 900))
        part = values[at : at + count]
        time = np.arange(at, at + len(part)) * S
        traces.add({"cell": Rows(time, np.stack((0 * part, part)), (at + len(part)) * S)})
        at += len(part)
    plot = traces.plot(found.signals("cell")[1])
    assert len(plot.time_ns) <= MAX_POINTS + MAX_POINTS // 2
    assert (plot.least.min(), plot.greatest.max()) == (values.min(), 99)
    assert (np.diff(plot.time_ns) > 0).all()
    peak = int(plot.greatest.argmax())
    assert plot.time_ns[peak] <= 31_337 * S < plot.time_ns[peak + 1]


@pytest.mark.parametrize(
    ("least", "greatest"),
    [(2.0**53, 2.0**53), (-(2.0**63), -(2.0**63)), (1.7e308, 1.7976931348623157e308), (-1.7976931348623157e308,) * 2,
     (-1.7976931348623157e308, 1.7976931348623157e308), (5e-324, 5e-324), (0.0, 5e-324), (2.0**53, 2.0**53 + 2)],
)  # fmt: skip
def test_plots_of_extreme_values_lie_in_the_picture(report: Report, least: float, greatest: float) -> None:
    signal = report.signals[0][0].signal
    plot = Plot(np.array([0, S]), np.full(2, least), np.array([least, greatest]))
    page = html(dataclasses.replace(report, signals=[[Drawn(signal, plot)], [], []]), pytest.fail)
    (path,) = re.findall(r'<path d="([^"]*)" fill="none" stroke="#1f6feb"', page)
    heights = [float(one) for one in re.findall(r"(?:V|M[0-9.]+ )(-?[0-9.]+)", path)]
    assert heights
    assert all(0 <= one <= 130 for one in heights), path
    assert not re.search(r"\b(inf|nan)\b", page.partition("<svg")[2].partition("</svg>")[0])
