"""Hooks of MkDocs for the documentation site: its navigation, the generated references, files of the repository."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any, Final

import api_pages
import command_pages
import history_pages
import proto_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT: Final = Path(__file__).parents[2]
_EXAMPLES: Final = sorted((ROOT / "examples").glob("*/README.md"))
EXAMPLES: Final = {f"examples/{page.parent.name}/README.md": f"examples/{page.parent.name}.md" for page in _EXAMPLES}
PROJECT: Final = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "SECURITY.md": "security.md"}
PAGES: Final = {**EXAMPLES, **PROJECT}
"""Pages outside docs that are pages of the site, too, with their place there."""
HISTORY, PLOTS = history_pages.pages(ROOT / "docs/reference/benchmark-history.csv")
GENERATED: Final = {
    "Options of all commands": command_pages.pages(),
    "Public Python names": api_pages.pages(),
    "Messages of gRPC": proto_pages.pages(ROOT / "proto"),
    "Figures": HISTORY,
}
"""The generated pages, by group: title and text of each, by its path."""
STYLE: Final = ".md-grid { max-width: 78rem; }  /* tables are wide */\n"
SHOWN: Final = ("examples", "packaging", "proto", "scene.toml", "tests")
"""Files and folders outside docs that pages may refer to. The site has copies of the files that they name."""
LINK: Final = re.compile(r"(?<=\]\()([^)\s#:]+)(#[^)\s]*)?(?=\))")
ROW: Final = re.compile(r"^\| ([^|]+) \| (.*) \|$", re.MULTILINE)
TITLED: Final = re.compile(r"\[([^\]]+)\]\(([^)#\s]+\.md)\)")
CODE: Final = re.compile(r"`[^`\n]*`")
FENCE: Final = re.compile(r"^( *)```.*?^\1```$", re.DOTALL | re.MULTILINE)
ITEM: Final = re.compile(r" *(?:-|\d+\.) +(?=\S)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Make the navigation from the tables of docs/index.md."""
    index = (Path(config.docs_dir) / "index.md").read_text()
    nav: list[Any] = [{"shmio": "index.md"}]
    for title, section in re.findall(r"^## (How to|Reference)$(.*?)(?=^## |\Z)", index, re.DOTALL | re.MULTILINE):
        groups: list[Any] = []
        for name, links in ROW.findall(section):
            groups.append({name: [{_capital(text): path} for text, path in TITLED.findall(links)]})
        nav.append({title: groups})
    if len(nav) != 3:
        raise PluginError("docs/index.md has no tables 'How to' and 'Reference', from which the navigation is made")
    nav[-1]["Reference"] += [
        {title: [{one: path} for path, (one, _) in part.items()]} for title, part in GENERATED.items()
    ]
    nav.append({"Explanation": [_explained(path) for path in sorted(Path(config.docs_dir).glob("explanation/*.md"))]})
    decisions = sorted(path.name for path in Path(config.docs_dir).glob("decisions/0*"))
    nav.append({"Decisions": ["decisions/README.md", *(f"decisions/{name}" for name in decisions)]})
    nav.append({"Examples": list(EXAMPLES.values())})
    nav.append({"Project": [{title.removesuffix(".md").capitalize(): path} for title, path in PROJECT.items()]})
    config.nav = nav
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, those outside docs, and files to which pages link."""
    for part in GENERATED.values():
        for path, (_, text) in part.items():
            files.append(File.generated(config, path, content=text))
    for path, plot in PLOTS.items():
        files.append(File.generated(config, path, content=plot))
    files.append(File.generated(config, "site.css", content=STYLE))
    for name, path in PAGES.items():
        files.append(File.generated(config, path, content=(ROOT / name).read_text()))
    for file in _referred(Path(config.docs_dir)):
        files.append(File.generated(config, f"files/{file.relative_to(ROOT).as_posix()}", abs_src_path=str(file)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Lead links out of docs to the site's copies; write pipes in tables, and lists, as this Markdown needs them."""
    source = page.file.src_uri
    folder = posixpath.dirname({page: name for name, page in PAGES.items()}.get(source, f"docs/{source}"))

    def moved(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, match[1]))
        if target in ("README.md", "."):
            found = "index.md"
        elif target in PAGES:
            found = PAGES[target]
        elif target.startswith("docs/"):
            found = target.removeprefix("docs/")
        else:
            found = f"files/{target}"
        anchor = "" if found == "index.md" else match[2] or ""
        return posixpath.relpath(found, posixpath.dirname(source) or ".") + anchor

    def line(text: str) -> str:
        return CODE.sub(lambda code: code[0].replace("\\|", "|"), text) if text.startswith("|") else text

    parts = re.split(r"(^ *```.*?^ *```$)", _indented(markdown), flags=re.DOTALL | re.MULTILINE)
    parts[::2] = [LINK.sub(moved, "\n".join(map(line, part.split("\n")))) for part in parts[::2]]
    return "".join(parts)


def on_page_content(html: str, **_: object) -> str:
    """Drop the roles of Sphinx, such as :func:, which docstrings have for editors."""
    return re.sub(r":\w+:(<code>)~?", r"\1", html)


def _indented(markdown: str) -> str:
    """Indent what belongs to an item of a list by four spaces; our pages do so by as many as its marker takes."""
    columns = [(0, 0)]  # where the text of each open item begins: in the page, and here
    fenced = False
    lines = []
    for line in markdown.split("\n"):
        indent = len(line) - len(line.lstrip(" "))
        while line and not fenced and indent < columns[-1][0]:
            columns.pop()
        before, after = columns[-1]
        lines.append(" " * (after - before) + line if line else "")
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced and (item := ITEM.match(line)):
            columns.append((item.end(), indent + after - before + 4))
    return "\n".join(lines)


def _referred(docs: Path) -> set[Path]:
    """Return the files outside docs to which pages link."""
    found = set()
    pages = [*docs.rglob("*.md"), *(ROOT / name for name in PAGES)]
    for page in pages:
        for path, _ in LINK.findall(FENCE.sub("", page.read_text())):
            file = (page.parent / path).resolve()
            name = file.relative_to(ROOT).as_posix() if file.is_relative_to(ROOT) else ""
            if file.is_file() and name not in PAGES and name.partition("/")[0] in SHOWN:
                found.add(file)
    return found


def _explained(path: Path) -> dict[str, str]:
    title = re.search(r"^# (.*)$", path.read_text(), re.MULTILINE)
    return {title[1] if title else path.stem: f"explanation/{path.name}"}


def _capital(text: str) -> str:
    plain = text.replace("`", "")
    return plain[:1].upper() + plain[1:]
