"""The addresses of other cells' pages: which of them become links."""

from __future__ import annotations

import pytest

from shmio.endpoints.web.cells import MAX_TEXT, page_address

LOCAL, LAN = "127.0.0.1:8080", "10.76.0.5:8080"


@pytest.mark.parametrize(
    ("web", "url"),
    [
        ("http://10.76.0.9:8080", "http://10.76.0.9:8080/"),
        ("https://cell-a.plant:8443", "https://cell-a.plant:8443/"),
        ("HTTPS://cell-a", "https://cell-a/"),
        ("http://[fd00::9]:8080", "http://[fd00::9]:8080/"),
        ("http://0.0.0.0:8080", "http://far:8080/"),
        ("http://[::]:8080", "http://far:8080/"),
    ],
)
def test_a_page_that_can_be_reached_has_a_link(web: str, url: str) -> None:
    assert page_address(web, "far", LAN, here=False) == (url, "")


@pytest.mark.parametrize(
    "web", ["http://127.0.0.1:8080", "http://127.8.0.1:8080", "http://[::1]:80", "http://localhost"]
)
def test_a_page_on_loopback_has_a_link_only_for_a_browser_on_its_host(web: str) -> None:
    url, why = page_address(web, "far", LOCAL, here=False)
    assert not url
    assert "only on the host far" in why
    assert web in why
    url, why = page_address(web, "near", LAN, here=True)
    assert not url
    assert "only on this server's host" in why
    for browser in (LOCAL, "localhost:8080", "[::1]:8080"):
        assert page_address(web, "near", browser, here=True) == (f"{web}/", "")


def test_a_page_on_all_addresses_of_this_host_has_the_name_that_the_browser_uses() -> None:
    assert page_address("http://0.0.0.0:81", "near", LAN, here=True)[0] == "http://10.76.0.5:81/"
    assert page_address("http://[::]:81", "near", "[fd00::5]:80", here=True)[0] == "http://[fd00::5]:81/"


@pytest.mark.parametrize(
    "web",
    [
        "javascript:alert(1)",
        "javascript://10.76.0.9/%0aalert(1)",
        " javascript:alert(1)",
        "data:text/html,<script>alert(1)</script>",
        "file:///etc/passwd",
        "//10.76.0.9",
        "http://",
        "http://user:pass@10.76.0.9",
        "http://a@10.76.0.9",
        "http://10.76.0.9:99999",
        "http://10.76.0.9:x",
        "http://[::1",
        "http://[fe80::1%25eth0]",
        'http://a"onclick="x',
        "http://<b>",
        "http://a\\@b",
        "http://a b",
        "http://ä",
        "http://" + MAX_TEXT * "a",
    ],
)
def test_anything_else_is_only_text(web: str) -> None:
    url, why = page_address(web, "far", LOCAL, here=True)
    assert not url
    assert "not the address of a page" in why
    assert len(why) < 2 * MAX_TEXT


def test_a_path_is_left_out_and_a_hostile_name_of_a_host_is_no_link() -> None:
    assert page_address("http://10.76.0.9:80/x?y#z", "far", LAN, here=False)[0] == "http://10.76.0.9:80/"
    assert page_address("http://0.0.0.0:80", "evil/x", LAN, here=False)[0] == ""
    assert page_address("http://0.0.0.0:80", "near", "[", here=True)[0] == ""
    assert page_address("", "far", LAN, here=False) == ("", "it has no page")
