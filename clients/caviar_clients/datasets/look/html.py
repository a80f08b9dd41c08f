"""Parts of the page of a dataset (`look`) as HTML, and the document around them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from caviar_clients.datasets.look.pictures import Picture


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    name: str
    """In the page's address, after ``#``."""
    title: str
    body: str
    """HTML."""


def figure(shown: Picture, caption: str) -> str:
    """Make a picture with a caption.

    Args:
        shown: The picture; dark pages show its dark form.
        caption: Text below it.
    """
    dark = f'<source srcset="{shown.dark}" media="(prefers-color-scheme: dark)">' if shown.dark else ""
    return (
        f'<figure><picture>{dark}<img src="{shown.light}" width="{shown.width}" height="{shown.height}" '
        f'alt="{escape(shown.alt)}"></picture><figcaption>{escape(caption)}</figcaption></figure>'
    )


def table(
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    code: Sequence[int] = (),
    right: Sequence[int] = (),
) -> str:
    """Make a table.

    Args:
        heads: Of the columns.
        rows: Texts.
        code: Columns of names as programs have them.
        right: Columns of numbers.

    Example:
        >>> table(("topic",), [("<b>",)]).count("&lt;b&gt;")
        1
    """

    def cell(tag: str, column: int, text: str) -> str:
        inner = escape(text)
        if tag == "td" and column in code and text:
            inner = f"<code>{inner}</code>"
        scope = ' scope="col"' if tag == "th" else ""
        side = ' class="right"' if column in right else ""
        return f"<{tag}{scope}{side}>{inner}</{tag}>"

    head = "".join(cell("th", column, text) for column, text in enumerate(heads))
    lines = ("".join(cell("td", column, text) for column, text in enumerate(row)) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def folded(title: str, body: str) -> str:
    """Make a part that opens when its title is clicked.

    Args:
        title: Text.
        body: HTML.
    """
    return f"<details><summary>{escape(title)}</summary>{body}</details>"


def facts(found: Mapping[str, str]) -> str:
    """Make a list of names and texts."""
    terms = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in found.items())
    return f'<dl class="facts">{terms}</dl>'


def absent(text: str) -> str:
    """Say why there is nothing."""
    return f'<p class="absent">{escape(text)}</p>'


_STYLE = """
:root { color-scheme: light dark; --ink: #222; --muted: #5c6166; --paper: #fff; --line: #dcdcdc;
  --soft: #f4f5f6; --link: #0060a0; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e6e8; --muted: #a3a9af; --paper: #17191c; --line: #33383d; --soft: #202327;
    --link: #7cc0ee; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1.25rem 4rem; max-width: 62rem; color: var(--ink);
  background: var(--paper); font: 1rem/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.3rem; margin: 2.6rem 0 .8rem; padding-top: .8rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
a { color: var(--link); }
nav ul { display: flex; flex-wrap: wrap; gap: .2rem 1.1rem; list-style: none; padding: 0; margin: .8rem 0 0; }
.lead, figcaption, .absent { color: var(--muted); }
.lead { margin: 0; }
.facts { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.2rem; margin: 0; }
.facts dt { color: var(--muted); }
.facts dd { margin: 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; width: 100%; }
th, td { text-align: left; vertical-align: top; padding: .3rem .9rem .3rem 0;
  border-bottom: 1px solid var(--line); }
th { color: var(--muted); font-weight: 600; white-space: nowrap; }
td { overflow-wrap: anywhere; min-width: 5rem; }
.right { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
code, pre { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .88em; }
pre { background: var(--soft); padding: .8rem; overflow-x: auto; max-height: 32rem; }
details { margin: .9rem 0; }
summary { cursor: pointer; color: var(--link); }
figure { margin: 1.2rem 0 1.8rem; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption { font-size: .9rem; margin-top: .5rem; }
.row { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: 1rem;
  margin-bottom: 1rem; }
.row figure { margin: 0; }
.row img { width: 100%; }
@media (max-width: 40rem) {
  .facts { grid-template-columns: 1fr; gap: 0; }
  .facts dd { margin-bottom: .5rem; }
}
"""

# Whatever is not in the file is forbidden: a page that lacked something would show it.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def document(name: str, folder: str, sections: Sequence[Section]) -> str:
    """Make the page.

    Args:
        name: Of the scenario.
        folder: Name of the dataset's folder.
        sections: Parts of the page.

    Returns:
        A whole document.
    """
    title = escape(f"{name} – dataset {folder}" if folder != name else f"{name} – dataset")
    links = "".join(f'<li><a href="#{part.name}">{escape(part.title)}</a></li>' for part in sections)
    body = "\n".join(
        f'<section id="{part.name}" aria-labelledby="h-{part.name}">\n'
        f'<h2 id="h-{part.name}">{escape(part.title)}</h2>\n{part.body}\n</section>'
        for part in sections
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{_STYLE}</style>
</head>
<body>
<header>
<h1>{escape(name)}</h1>
<p class="lead">A dataset of CAVIAR</p>
<nav aria-label="Sections"><ul>{links}</ul></nav>
</header>
<main>
{body}
</main>
</body>
</html>
"""
