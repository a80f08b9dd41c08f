"""Links between the pages of the repository lead to files and headings that exist."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).resolve().parents[2]
GENERATED = tuple(
    ROOT / "docs" / "reference" / name for name in ("api", "commands", "frame-path", "scenario")
)
"""Folders of pages that `make docs` makes and checks."""


def pages() -> list[str]:
    """Markdown files of the repository, those that are not committed yet included."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return sorted(page for page in set(listed.stdout.split()) if (ROOT / page).is_file())


def tokens(text: str) -> Iterator[Token]:
    """Every token of a page, those inside of paragraphs too."""
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        yield token
        yield from token.children or ()


def anchor(heading: str) -> str:
    """The name of a heading in links: as GitHub and MyST make it."""
    words = re.sub(r"[^\w\- ]", "", heading.lower())
    return words.replace(" ", "-")


@cache
def anchors(page: Path) -> frozenset[str]:
    """Names of the headings of a page; the second heading of one name has ``-1`` after it."""
    found: set[str] = set()
    seen: dict[str, int] = {}
    parsed = list(MarkdownIt("commonmark").enable("table").parse(page.read_text("utf-8")))
    for token, content in pairwise(parsed):
        if token.type == "heading_open":
            plain = "".join(
                child.content for child in content.children or () if child.type in ("text", "code_inline")
            )
            name = anchor(plain)
            count = seen[name] = seen.get(name, -1) + 1
            found.add(f"{name}-{count}" if count else name)
    return frozenset(found)


def is_rendered(page: Path) -> bool:
    """Whether `make docs` makes a page of a file."""
    beside = (ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md")
    return page in beside or any(page.is_relative_to(ROOT / folder) for folder in ("docs", "protocol"))


def dead_links(page: Path) -> Iterator[str]:
    """Links and pictures of a page that lead nowhere in the repository."""
    for token in tokens(page.read_text("utf-8")):
        target = str(token.attrs.get("href" if token.type == "link_open" else "src", ""))
        if token.type not in ("link_open", "image") or re.match(r"[a-z]+:", target):
            continue
        path, _, name = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if file.parent in GENERATED:
            continue
        if not file.exists():
            yield f"{target}: there is no such file"
        elif file.suffix == ".md" and is_rendered(page) and not is_rendered(file):
            yield f"{target}: make docs renders {page.name} and not {file.name}"
        elif name and (file.suffix != ".md" or name not in anchors(file)):
            yield f"{target}: {file.name} has no heading of that name"


@pytest.mark.parametrize("page", pages())
def test_every_link_of_a_page_leads_somewhere(page: str) -> None:
    assert not list(dead_links(ROOT / page)), f"{page} has links that lead nowhere"


def test_pages_that_are_linked_and_not_in_the_repository_are_generated() -> None:
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    assert {f"/{folder.relative_to(ROOT)}/" for folder in GENERATED} <= set(ignored)


def test_dead_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# Two words, `code`\n\n## Again\n\n## Again\n")
    page = tmp_path / "page.md"
    page.write_text(
        "# Page\n\n[1](other.md#two-words-code) [2](other.md#again-1) [3](#page) [4](https://example.org/x)\n"
        "```\n[5](nowhere.md)\n```\n[6](nowhere.md) [7](other.md#again-2) [8](#pag) ![9](no.png)\n"
    )
    assert list(dead_links(page)) == [
        "nowhere.md: there is no such file",
        "other.md#again-2: other.md has no heading of that name",
        "#pag: page.md has no heading of that name",
        "no.png: there is no such file",
    ]
