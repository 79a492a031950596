"""The web page of a cell with tokens, used by people with a browser: signing in and out, and what roles allow."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from shmio.testing.cell import CONFIG, Cell
from shmio.testing.ports import reserved_port

pytest.importorskip("uvicorn")
playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
expect: Any = playwright.expect
PATIENCE_MS = 30_000
TOKENS = {"viewer": ["read"], "operator": ["read", "write", "inject", "control"]}


def token(name: str) -> str:
    return f"{name}-0123456789abcdefghij"


@pytest.fixture
def open_page(make_cell: Callable[..., Cell]) -> Iterator[Callable[..., Any]]:
    """Start a cell with tokens, and open its page in a browser. The browser must report no error."""
    expect.set_options(timeout=PATIENCE_MS)
    errors: list[str] = []
    with reserved_port() as address, playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])

        def opened(roles: str) -> Any:
            config = CONFIG.replace("timeout = 1000", 'timeout = 1000\nwritable = ["Outputs"]')
            for name, allowed in TOKENS.items():
                config += f'[[grpc.token]]\nname = "{name}"\nroles = {allowed}\ntoken_file = "{name}"\n'
            cell = make_cell(config=f'{config}[web]\nlisten = "{address}"\n{roles}\n')
            for name in TOKENS:
                file = cell.folder / name
                file.write_text(token(name) + "\n")
                file.chmod(0o600)
            cell.up()
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.set_default_timeout(PATIENCE_MS)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(f"http://{address}/")
            return page

        yield opened
        browser.close()
    assert not errors


def sign_in(page: Any, text: str) -> None:
    page.get_by_label("Token").fill(text)
    page.get_by_role("dialog").get_by_role("button", name="Sign in").click()


def sign_out(page: Any) -> None:
    page.get_by_role("button", name="Sign out").click()


def test_nothing_is_seen_without_a_token(open_page: Callable[..., Any]) -> None:
    page = open_page("")
    expect(page.get_by_role("dialog", name="Sign in")).to_be_visible()
    sign_in(page, "a wrong token")
    expect(page.get_by_role("alert")).to_contain_text("grpc.token")
    expect(page.get_by_role("tab", name="Registers")).to_be_visible()
    assert not page.locator("#sources").count()
    sign_in(page, token("viewer"))
    expect(page.get_by_role("dialog")).to_have_count(0)
    expect(page.locator("#user")).to_contain_text("viewer (read)")
    expect(page.locator("#sources")).to_contain_text("good")
    expect(page.get_by_role("button", name="Restart cell")).to_be_disabled()
    (cookie,) = page.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
    assert token("viewer") not in cookie["value"]
    sign_out(page)
    expect(page.locator("main")).to_have_text("Sign in to see this cell.")
    assert not page.context.cookies()
    page.reload()
    expect(page.get_by_role("dialog", name="Sign in")).to_be_visible()


def test_roles_change_with_the_token(open_page: Callable[..., Any]) -> None:
    page = open_page('roles = ["read"]')
    page.get_by_role("tab", name="Registers").click()
    search, row = page.get_by_label("Search"), page.locator('.tree-row[data-path="cell/Outputs"]')
    search.fill("Outputs")
    row.click()
    for name in ("Write", "Override", "Lift"):
        expect(page.get_by_role("button", name=name, exact=True)).to_be_disabled()
    page.get_by_role("button", name="Sign in").click()
    sign_in(page, token("operator"))
    expect(page.locator("#user")).to_contain_text("operator")
    search.fill("Outputs")
    row.click()
    for name in ("Write", "Override", "Lift"):
        expect(page.get_by_role("button", name=name, exact=True)).to_be_enabled()
    sign_out(page)
    expect(page.locator("#user")).to_contain_text("no token (read)")
    search.fill("Outputs")
    row.click()
    expect(page.get_by_role("button", name="Write")).to_be_disabled()

    page.get_by_role("tab", name="Injections").click()
    lift = page.get_by_role("button", name="Lift all injections")
    expect(lift).to_be_disabled()
    page.get_by_role("button", name="Sign in").click()
    sign_in(page, token("operator"))
    expect(lift).to_be_enabled()  # the tab that is open has the new roles
    sign_out(page)
    expect(lift).to_be_disabled()
