"""The pages of the documentation: each link has a target, and each page is in an index."""

from __future__ import annotations

import csv
import re
import runpy
from collections.abc import Iterator
from datetime import date
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
EXAMPLES = [page for page in sorted((ROOT / "examples").rglob("README.md")) if "node_modules" not in page.parts]
PAGES = [*(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG", "SECURITY")), *EXAMPLES, *DOCS]
LINK = re.compile(r"\]\(\s*([^)\s]+)\s*\)")
FENCE = re.compile(r"^( *)```.*?^\1```$", re.DOTALL | re.MULTILINE)
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


@cache
def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to the page's headings."""
    headings = HEADING.findall(FENCE.sub("", page.read_text()))
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


def dead_links(page: Path) -> Iterator[str]:
    """Yield the links of a page that lead nowhere."""
    for link in LINK.findall(FENCE.sub("", page.read_text())):
        if re.match(r"[a-z]+:", link):
            continue  # another site
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists():
            yield f"{page}: {link}"
        elif anchor and target.suffix == ".md" and anchor not in anchors(target):
            yield f"{page}: {link}: no such heading"


def test_links_have_existing_targets() -> None:
    assert len(PAGES) > 100
    assert [link for page in PAGES for link in dead_links(page)] == []


def test_every_page_is_in_an_index() -> None:
    index = (ROOT / "docs/index.md").read_text() + (ROOT / "docs/decisions/README.md").read_text()
    for page in DOCS:
        assert page.name in index or page.name in ("index.md", "README.md"), f"{page} is in no index"


def test_every_picture_is_shown() -> None:
    text = "".join(page.read_text() for page in PAGES)
    for picture in (ROOT / "docs/images").iterdir():
        assert f"images/{picture.name})" in text, f"no page shows {picture}"


def test_the_badges_are_true() -> None:
    badges = runpy.run_path(str(ROOT / "scripts/make-badges"))
    again = "run scripts/make-badges"
    assert badges["PICTURE"].read_text() == badges["picture"](), again
    assert f"![{badges['description']()}](docs/images/badges.svg)" in (ROOT / "README.md").read_text(), again


def test_the_tour_is_short() -> None:
    """Two screens: the tour ends within 60 lines of text, output and commands."""
    before, _, _ = (ROOT / "README.md").read_text().partition("## Three scenarios")
    assert len([line for line in before.splitlines() if line and not line.startswith("```")]) <= 60


def test_the_history_of_the_benchmarks_can_be_plotted() -> None:
    """A figure keeps its unit, or its plot would mix two; runs are in the order of their dates."""
    with (ROOT / "docs/reference/benchmark-history.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    units: dict[tuple[str, str], tuple[str, str]] = {}
    for row in rows:
        assert (ROOT / f"benchmarks/{row['benchmark']}.py").is_file(), row
        assert re.fullmatch(r"[0-9a-f]{8}", row["commit"]), row
        assert float(row["value"]) > 0, row
        assert row["better"] in ("less", "more"), row
        unit = row["unit"], row["better"]
        assert units.setdefault((row["benchmark"], row["figure"]), unit) == unit, row
    dates = [date.fromisoformat(row["date"]) for row in rows]
    assert dates == sorted(dates)
