"""Writes reports on verdicts: as one self-contained HTML page without scripts, or as JUnit XML."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Final, NamedTuple

import msgspec
import numpy as np

from shmio.config import Declaration, Expectation
from shmio.judging.pieces import Piece, head
from shmio.judging.source import Signal, Trouble
from shmio.judging.trace import Plot, compressed
from shmio.judging.verdict import Outcome, Verdict, distance, number_text

_Place = Callable[[float], float]
_WIDTH, _HEIGHT, _LEFT, _BOTTOM = 860, 130, 70, 20
_SHOWN_SPANS: Final = 20
_MOST: Final = float(np.finfo(np.float64).max)
_NO_XML: Final = dict.fromkeys(
    [*range(9), 11, 12, *range(14, 32), 0xFFFE, 0xFFFF, *range(0xD800, 0xE000)], "\N{REPLACEMENT CHARACTER}"
)
"""Characters that XML cannot contain."""
_STYLE: Final = """
body { font: 14px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 960px; padding: 0 1em; color: #1c2733;
  background: #fff }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin: 2em 0 .3em; border-top: 1px solid #d5dbe1; padding-top: 1em }
table { border-collapse: collapse; width: 100% } td, th { text-align: left; padding: .2em .7em .2em 0;
  vertical-align: top; border-bottom: 1px solid #e6eaee } th { font-weight: 600 }
code, pre { font: 13px ui-monospace, monospace; overflow-wrap: anywhere; white-space: pre-wrap; margin: .2em 0 }
.passed { color: #18713a } .failed { color: #b3261e } .inconclusive { color: #8a5a00 }
.outcome { font-weight: 600 } .dim { color: #5b6875 }
svg { display: block; margin: .4em 0 } svg text { font: 11px system-ui, sans-serif; fill: #5b6875 }
@media print { h2 { break-after: avoid } svg { break-inside: avoid } }
"""


class Span(NamedTuple):
    """When an injection was active, in ns of instance time; ``end_ns`` is None if it was active to the end."""

    name: str
    source: str
    begin_ns: int
    end_ns: int | None


@dataclass(frozen=True)
class Drawn:
    """A signal of an expectation, with what its plot shows."""

    signal: Signal
    plot: Plot
    troubles: Sequence[Trouble] = ()
    limits: tuple[Piece, Piece] | None = None
    """The lower and the upper limit of the signal; None if the expectation has no ``like``."""


@dataclass(frozen=True)
class Report:
    """The contents of a report.

    Attributes:
        title: The heading.
        facts: Names and values, such as the seed and digests.
        command: The command line that repeats the run.
        begin_ns: Start of the judged time, in ns; None if it never began.
        end_ns: End of the judged time, in ns.
        verdicts: The verdicts.
        signals: For each verdict, the signals that its expectation reads.
        injections: When injections were active.
        declared: The injections of the campaign, with their seeds.
    """

    title: str
    facts: Sequence[tuple[str, str]]
    command: str
    begin_ns: int | None
    end_ns: int
    verdicts: Sequence[Verdict]
    signals: Sequence[Sequence[Drawn]]
    injections: Sequence[Span] = field(default=())
    declared: Sequence[Declaration] = field(default=())


def fault_of(error: Exception) -> str:
    """Return an unexpected error as text."""
    return f"{type(error).__name__}: {error}"


def describe(expectation: Expectation) -> str:
    """Return what is expected, as lines of the form ``key = value``."""
    return _keys(expectation, "name", "severity", "text", "requirement")


def _keys(table: Declaration | Expectation, *left_out: str) -> str:
    """Return the keys of a table that are not left out, as lines of the form ``key = value``."""
    keys = {key: value for key, value in msgspec.to_builtins(table).items() if key not in left_out}
    return "\n".join(f"{key} = {msgspec.json.encode(value).decode()}" for key, value in keys.items())


# -- HTML --------------------------------------------------------------------------------------------------------------


def html(report: Report, warn: Callable[[str], None] = lambda _text: None) -> str:
    """Return the report as an HTML page.

    Args:
        report: The report.
        warn: Called with the name and the fault of each plot that cannot be drawn. The page then
            has the fault in the plot's place.
    """
    return "\n".join(_page(report, warn)) + "\n"


def _page(report: Report, warn: Callable[[str], None]) -> Iterator[str]:
    yield f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(report.title)}</title>'
    yield "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">"
    yield f"<style>{_STYLE}</style></head><body>\n<h1>{escape(report.title)}</h1>"
    counts = [(outcome, sum(one.outcome is outcome for one in report.verdicts)) for outcome in Outcome]
    yield "<p>" + ", ".join(f'<span class="outcome {one}">{count} {one}</span>' for one, count in counts) + "</p>"
    yield "<table>"
    for name, value in report.facts:
        yield f"<tr><th>{escape(name)}</th><td><code>{escape(value)}</code></td></tr>"
    yield f"</table>\n<p>Repeat it:</p><pre>{escape(report.command)}</pre>"
    heads = ("expectation", "verdict", "robustness", "severity", "requirement", "reason")
    yield f"<h2>Verdicts</h2>\n<table><tr>{''.join(f'<th>{head}' for head in heads)}</tr>"
    for at, verdict in enumerate(report.verdicts):
        one = verdict.expectation
        yield (
            f'<tr><td><a href="#e{at}">{escape(one.name)}</a><td>{_outcome(verdict)}<td>{_robustness(verdict)}'
            f"<td>{one.severity}<td>{escape(one.requirement)}<td>{escape(verdict.reason)}{_moment(verdict)}</tr>"
        )
    yield "</table>"
    yield from _injections(report)
    for at, (verdict, signals) in enumerate(zip(report.verdicts, report.signals, strict=True)):
        yield from _section(report, at, verdict, signals, warn)
    yield "</body></html>"


def _injections(report: Report) -> Iterator[str]:
    """Yield a table of the campaign's injections, and of others that were active."""
    if not (report.declared or report.injections):
        return
    active: dict[str, list[Span]] = {}
    for span in report.injections:
        active.setdefault(span.name, []).append(span)
    heads = ("injection", "target", "operation", "keys", "seed", "active")
    yield f"<h2>Injections</h2>\n<table><tr>{''.join(f'<th>{head}' for head in heads)}</tr>"
    for one in report.declared:
        targets = [one.target] if isinstance(one.target, str) else one.target
        target = "<br>".join(f"<code>{escape(target)}</code>" for target in targets)
        keys = escape(_keys(one, "name", "target", "operation", "seed"))
        yield (
            f"<tr><td>{escape(one.name)}<td>{target}<td>{one.operation}<td><pre>{keys}</pre>"
            f"<td>{'' if one.seed is None else one.seed}<td>{_active(active.pop(one.name, []))}</tr>"
        )
    for name, spans in active.items():
        yield f"<tr><td>{escape(name)}<td>{escape(spans[0].source)}<td><td><td><td>{_active(spans)}</tr>"
    yield "</table>"


def _active(spans: Sequence[Span]) -> str:
    """Return when an injection was active; at most ``_SHOWN_SPANS`` times."""
    shown = [
        f"{span.begin_ns / 1e9:.3f} s to {'the end' if span.end_ns is None else f'{span.end_ns / 1e9:.3f} s'}"
        for span in spans[:_SHOWN_SPANS]
    ]
    more = [f"and {len(spans) - _SHOWN_SPANS} more times"] if len(spans) > _SHOWN_SPANS else []
    return "<br>".join([*shown, *more]) or "never"


def _section(
    report: Report, at: int, verdict: Verdict, signals: Sequence[Drawn], warn: Callable[[str], None]
) -> Iterator[str]:
    one = verdict.expectation
    requirement = f' <span class="dim">{escape(one.requirement)}</span>' if one.requirement else ""
    yield f'<h2 id="e{at}">{escape(one.name)}: {_outcome(verdict)}{requirement}</h2>'
    if one.text:
        yield f"<p>{escape(one.text)}</p>"
    yield f"<pre>{escape(describe(one))}</pre>"
    if verdict.reason:
        yield f"<p>{escape(verdict.reason)}{_moment(verdict)}</p>"
    for drawn in signals:
        try:
            yield _svg(report, verdict, drawn)
        except Exception as error:  # noqa: BLE001  a plot may cost no verdict
            fault = f"the plot of {drawn.signal.name} cannot be drawn: {fault_of(error)}"
            warn(fault)
            yield f'<p class="dim">{escape(fault)}</p>'
    if verdict.around:
        yield "<table><tr><th>around the moment<th>time and value</tr>"
        for name, pairs in verdict.around.items():
            values = ", ".join(f"{time / 1e9:.3f} s: {_number(value)}" for time, value in pairs)
            yield f"<tr><td><code>{escape(name)}</code><td>{values}</tr>"
        yield "</table>"


def _outcome(verdict: Verdict) -> str:
    return f'<span class="outcome {verdict.outcome}">{verdict.outcome}</span>'


def _robustness(verdict: Verdict) -> str:
    if verdict.robustness is not None:
        return _number(verdict.robustness)
    low, high = distance(verdict.low), distance(verdict.high)
    return "" if low is None and high is None else f"{_number(low, 'any')} to {_number(high, 'any')}"


def _moment(verdict: Verdict) -> str:
    return "" if verdict.moment_ns is None else f" at {verdict.moment_ns / 1e9:.3f} s"


def _number(value: float | None, otherwise: str = "unknown") -> str:
    return otherwise if value is None else number_text(value, 6)


def _svg(report: Report, verdict: Verdict, drawn: Drawn) -> str:
    """Return the plot of a signal as SVG: a line of steps, and behind it the injections and unknown times."""
    begin = report.begin_ns or 0
    end = max(report.end_ns, begin + 1)
    plot = drawn.plot
    lines = [(plot, "#1f6feb")]
    within = [head(limit, end) for limit in drawn.limits or ()]
    lines += [(compressed(limit.time, limit.low, limit.high), "#2da44e") for limit in within]
    shown = np.concatenate([side[np.isfinite(side)] for line, _ in lines for side in (line.least, line.greatest)])
    least, greatest = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)
    if not greatest / 2 - least / 2:  # a constant, of any size
        room = max(0.5, abs(least) / 1000)
        least, greatest = max(least - room, -_MOST), min(greatest + room, _MOST)
    half = greatest / 2 - least / 2  # the whole may exceed a float

    def x(time_ns: float) -> float:
        return _LEFT + (_WIDTH - _LEFT) * min(max((time_ns - begin) / (end - begin), 0.0), 1.0)

    def y(value: float) -> float:
        return _HEIGHT - _BOTTOM - 6 - (value / 2 - least / 2) / half * (_HEIGHT - _BOTTOM - 12)

    size = f'viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}"'
    parts = [f'<svg {size} role="img"><title>{escape(drawn.signal.name)}</title>']
    parts += (
        _band(x(span.begin_ns), x(end if span.end_ns is None else span.end_ns), "#f2a60033",
              f"injection {span.name} on {span.source}")
        for span in report.injections
    )  # fmt: skip
    parts += (_band(x(trouble.begin_ns), x(trouble.end_ns), "#77777755", trouble.reason) for trouble in drawn.troubles)
    parts += (
        f'<path d="{_steps(line, x, y, end)}" fill="none" stroke="{colour}" stroke-width="1.2"/>'
        for line, colour in reversed(lines)
    )
    if verdict.moment_ns is not None:
        at = x(verdict.moment_ns)
        parts.append(
            f'<line x1="{at:.1f}" x2="{at:.1f}" y1="0" y2="{_HEIGHT - _BOTTOM}" stroke="#b3261e" stroke-width="1.5">'
            f"<title>failed at {verdict.moment_ns / 1e9:.3f} s</title></line>"
        )
    floor = _HEIGHT - _BOTTOM
    parts.append(f'<path d="M{_LEFT} 0V{floor}H{_WIDTH}" fill="none" stroke="#9aa5b1"/>')
    for value, at in ((greatest, 10), (least, floor - 2)):
        parts.append(f'<text x="{_LEFT - 6}" y="{at}" text-anchor="end">{value:.5g}</text>')
    parts.append(f'<text x="{_LEFT}" y="{_HEIGHT - 5}">{begin / 1e9:.3f} s</text>')
    parts.append(f'<text x="{_WIDTH / 2}" y="{_HEIGHT - 5}" text-anchor="middle">{escape(drawn.signal.name)}</text>')
    parts.append(f'<text x="{_WIDTH}" y="{_HEIGHT - 5}" text-anchor="end">{(end - 1) / 1e9:.3f} s</text></svg>')
    return "".join(parts)


def _band(left: float, right: float, colour: str, title: str) -> str:
    width = max(right - left, 0.6)
    return (
        f'<rect x="{left:.1f}" y="0" width="{width:.1f}" height="{_HEIGHT - _BOTTOM}" fill="{colour}">'
        f"<title>{escape(title)}</title></rect>"
    )


def _steps(plot: Plot, x: _Place, y: _Place, end: int) -> str:
    """Return the line as an SVG path, with a gap where values are unknown."""
    known = np.isfinite(plot.least) & np.isfinite(plot.greatest)
    following = np.append(plot.time_ns[1:], end).tolist()
    path: list[str] = []
    drawing = False
    for time, least, greatest, good, after in zip(
        plot.time_ns.tolist(), plot.least.tolist(), plot.greatest.tolist(), known.tolist(), following, strict=True
    ):
        if not good:
            drawing = False
            continue
        low, high = f"{y(least):.1f}", f"{y(greatest):.1f}"
        path.append(f"V{low}" if drawing else f"M{x(time):.1f} {low}")
        path.append(f"H{x(after):.1f}" if low == high else f"V{high}H{x(after):.1f}")
        drawing = True
    return "".join(path)


# -- JUnit -------------------------------------------------------------------------------------------------------------


def junit(report: Report) -> bytes:
    """Return the report as JUnit XML. An inconclusive verdict is an error."""
    duration_s = 0.0 if report.begin_ns is None else (report.end_ns - 1 - report.begin_ns) / 1e9
    failed, inconclusive = (
        sum(one.outcome is outcome for one in report.verdicts) for outcome in (Outcome.FAILED, Outcome.INCONCLUSIVE)
    )
    suite = ET.Element(
        "testsuite", name=_text(report.title), tests=str(len(report.verdicts)), failures=str(failed),
        errors=str(inconclusive), skipped="0", time=f"{duration_s:.3f}",
    )  # fmt: skip
    properties = ET.SubElement(suite, "properties")
    for name, value in (*report.facts, ("command", report.command)):
        ET.SubElement(properties, "property", name=_text(name), value=_text(value))
    for verdict in report.verdicts:
        _case(suite, report.title, verdict, duration_s)
    ET.indent(suite)
    data: bytes = ET.tostring(suite, encoding="utf-8", xml_declaration=True)
    return data + b"\n"


def _case(suite: ET.Element, title: str, verdict: Verdict, duration_s: float) -> None:
    one = verdict.expectation
    case = ET.SubElement(suite, "testcase", classname=_text(title), name=_text(one.name), time=f"{duration_s:.3f}")
    properties = ET.SubElement(case, "properties")
    values = {"severity": one.severity, "requirement": one.requirement, "text": one.text}
    if verdict.robustness is not None:
        values["robustness"] = repr(verdict.robustness)
    for name, value in values.items():
        if value:
            ET.SubElement(properties, "property", name=name, value=_text(value))
    if verdict.outcome is Outcome.PASSED:
        return
    at = "" if verdict.moment_ns is None else f" at {verdict.moment_ns / 1e9:.3f} s"
    kind = "failure" if verdict.outcome is Outcome.FAILED else "error"
    found = ET.SubElement(case, kind, type=str(verdict.outcome), message=_text(f"{verdict.reason}{at}"))
    lines = [describe(one)]
    for name, pairs in verdict.around.items():
        lines.append(f"{name}: {', '.join(f'{time / 1e9:.3f} s: {_number(value)}' for time, value in pairs)}")
    found.text = _text("\n".join(lines))


def _text(text: str) -> str:
    return text.translate(_NO_XML)
