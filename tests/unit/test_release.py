"""The release script: it makes a version from the changes, and releases only what is tagged and consistent."""

from __future__ import annotations

import datetime
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHANGELOG = """# Changelog

Intro.

## Unreleased

### Added

- One.

### Fixed

- Two.

## 0.1.0 - 2026-01-01

- Old.
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a folder with the files that the script reads and writes."""
    for name in ("scripts/release", "pyproject.toml", "packaging/client/pyproject.toml", "shmio/version.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "changes").mkdir()
    (tmp_path / "changes" / "README.md").write_text("not a change")
    (tmp_path / "CHANGELOG.md").write_text(CHANGELOG)
    return tmp_path


def release(tree: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command: list[str | Path] = [sys.executable, tree / "scripts" / "release", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=tree)


def git(tree: Path, *arguments: str) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    subprocess.run(["git", *who, *arguments], cwd=tree, check=True, capture_output=True)


def test_a_version_gets_its_section_and_its_numbers(tree: Path) -> None:
    (tree / "changes" / "a.fixed.md").write_text("- Three.\n")
    (tree / "changes" / "b.changed.md").write_text("- Four.\n\n")
    done = release(tree, "--prepare", "0.2.0rc1")
    assert (done.returncode, done.stderr) == (0, "")
    text = re.sub(r"\d{4}-\d\d-\d\d\n", "DAY\n", (tree / "CHANGELOG.md").read_text(), count=1)
    assert text == CHANGELOG.replace("## Unreleased\n", "## Unreleased\n\n## 0.2.0rc1 - DAY\n").replace(
        "- Two.\n", "- Two.\n- Three.\n\n### Changed\n\n- Four.\n"
    )
    assert [file.name for file in (tree / "changes").iterdir()] == ["README.md"]
    for name in ("pyproject.toml", "packaging/client/pyproject.toml", "shmio/version.py"):
        assert (tree / name).read_text().count('"0.2.0rc1"') == 1
    assert "already" in release(tree, "--prepare", "0.2.0rc1").stderr


@pytest.mark.parametrize(
    ("name", "version", "why"),
    [("a.fixed.md", "two", "'two'"), ("a.md", "0.2.0", "a.md"), ("a.new.md", "0.2.0", "added")],
)
def test_what_is_wrong_is_refused_and_changes_nothing(tree: Path, name: str, version: str, why: str) -> None:
    (tree / "changes" / name).write_text("- Three.\n")
    done = release(tree, "--prepare", version)
    assert done.returncode == 1
    assert why in done.stderr
    assert (tree / "CHANGELOG.md").read_text() == CHANGELOG


def test_only_a_tag_with_its_own_version_is_released(tree: Path) -> None:
    git(tree, "init", "-q")
    git(tree, "add", "-A")
    git(tree, "commit", "-qm", "x")
    assert "0 tags" in release(tree).stderr
    git(tree, "tag", "v0.2.0")
    assert "--prepare 0.2.0" in release(tree).stderr
    assert release(tree, "--prepare", "0.2.0").returncode == 0
    assert "not committed" in release(tree).stderr
    git(tree, "commit", "-qam", "y")
    assert "0 tags" in release(tree).stderr
    git(tree, "tag", "-f", "v0.2.0")
    assert "store-baseline 0.2.0" in release(tree).stderr
    (tree / "changes" / "late.fixed.md").write_text("- Late.\n")
    git(tree, "add", "-A")
    git(tree, "commit", "-qm", "z")
    git(tree, "tag", "-f", "v0.2.0")
    assert "complete section" in release(tree).stderr


def test_each_package_must_have_been_built_lately_from_this_history(tree: Path) -> None:
    (tree / "tests/compatibility/baselines/0.2.0").mkdir(parents=True)
    (tree / "tests/compatibility/baselines/0.2.0/a").touch()
    git(tree, "init", "-q")
    assert release(tree, "--prepare", "0.2.0").returncode == 0
    git(tree, "add", "-A")
    git(tree, "commit", "-qm", "x")
    today = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}"
    file = tree / "packaging" / "builds.json"
    scripts = {"wheel": "build-dist", "shmio-client": "build-dist", "deb": "build-deb", "image": "build-image"}

    def head() -> str:
        command = ["git", "rev-parse", "--short=12", "HEAD"]
        return subprocess.run(command, cwd=tree, capture_output=True, text=True, check=True).stdout.strip()

    def refusal(built: str, commit: str) -> str:
        file.write_text(json.dumps({name: {"built": built, "commit": commit} for name in scripts if commit}))
        git(tree, "add", "-A")
        git(tree, "commit", "-qm", "y")
        git(tree, "tag", "-f", "v0.2.0")
        return release(tree).stderr

    for why, built, commit in (
        ("this package was never built", "", ""),
        ("this package was last built", "2026-01-01", head()),
        ("this package was last built from 0123456789ab, which is no part of this version", today, "0123456789ab"),
    ):
        said = refusal(built, commit)
        for name, script in scripts.items():
            assert f"{name}: {why}" in said
            assert f"run scripts/{script}, and commit packaging/builds.json" in said
    assert release(tree, "--record", *scripts).returncode == 0
    assert json.loads(file.read_text()) == {name: {"built": today, "commit": head()} for name in scripts}
    told = "".join(f"{name}: last built on {today} from {head()}\n" for name in scripts)
    assert release(tree, "--builds").stdout == told
