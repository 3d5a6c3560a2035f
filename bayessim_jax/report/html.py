"""The page: one HTML file that needs nothing else, with a stylesheet for light and dark screens."""

from __future__ import annotations

from html import escape as escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = ["commands", "details", "figure", "figures", "findings", "notice", "page", "section", "table"]

CSS = """
:root { --sans: system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
  --ink: #1c2026; --soft: #5c6570; --paper: #ffffff; --card: #f5f6f8; --line: #dfe3e8;
  --warn: #9a4a00; --warn-card: #fff4e6; --good: #1e6b3a; --good-card: #eaf6ee; color-scheme: light dark; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e7eb; --soft: #9aa4b0; --paper: #14171b; --card: #1d2127;
  --line: #333a43; --warn: #ffb86b; --warn-card: #33240f; --good: #7ddc9b; --good-card: #12291a; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.55 var(--sans); }
main { max-width: 62rem; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .4rem; letter-spacing: -.01em; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .6rem; padding-top: .9rem; border-top: 1px solid var(--line); }
p { max-width: 46rem; margin: .5rem 0; }
.lead { font-size: 1.15rem; line-height: 1.5; }
.soft, figcaption, footer { color: var(--soft); font-size: .9rem; }
.notice { padding: .7rem 1rem; border-radius: .5rem; border-left: .25rem solid var(--warn);
  background: var(--warn-card); max-width: none; }
.notice.good { border-color: var(--good); background: var(--good-card); }
.figures { display: grid; gap: 1.25rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, var(--least, 24rem)), 1fr)); }
figure { margin: 0; padding: .9rem; background: var(--card); border-radius: .6rem; min-width: 0; }
figure svg { display: block; width: 100%; height: auto; margin: 0 auto; color: var(--ink); }
figure.wide { grid-column: 1 / -1; }
figcaption { margin-top: .5rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; margin: .6rem 0; }
th, td { text-align: right; padding: .3rem .8rem .3rem 0; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; white-space: normal; min-width: 10rem; }
th { font-weight: 600; color: var(--soft); }
pre { background: var(--card); border-radius: .5rem; padding: .8rem 1rem; overflow-x: auto; margin: .3rem 0 .9rem; }
code { font: .88rem/1.5 ui-monospace, "SF Mono", Menlo, Consolas, monospace; }
summary { cursor: pointer; color: var(--soft); margin: .6rem 0; }
.controls { display: flex; flex-wrap: wrap; gap: .4rem 1rem; align-items: center; margin: 0 0 .6rem; max-width: none; }
.controls input { flex: 1; min-width: 8rem; }
.key { font-size: .85rem; color: var(--soft); } .key i { display: inline-block; width: .9rem; height: .3rem;
  margin-right: .35rem; vertical-align: middle; border-radius: .15rem; }
canvas { display: block; width: 100%; touch-action: pan-y; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: 1rem; }
"""

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def page(title: str, body: str, *, script: str = "", script_hash: str = "") -> str:
    """The whole document; a content policy in its head forbids any access to the network and every other script."""
    policy = f"{POLICY}; script-src '{script_hash}'" if script_hash else POLICY
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n{script}</body>\n</html>\n"
    )


def section(title: str, *parts: str) -> str:
    """A heading and what stands under it."""
    return f"<section>\n<h2>{escape(title)}</h2>\n" + "\n".join(parts) + "\n</section>"


def figures(*parts: str, least: str = "24rem") -> str:
    """Figures side by side where the screen is wide enough for each to have its least width."""
    return f'<div class="figures" style="--least: {least}">' + "\n".join(parts) + "</div>"


def figure(svg: str, alt: str, caption: str, *, wide: bool = False) -> str:
    """A figure with words for those who cannot see it, and a caption; a wide one has a row for itself."""
    svg = svg.replace("<svg", f'<svg role="img" aria-label="{escape(alt)}"', 1)
    opening = '<figure class="wide">' if wide else "<figure>"
    return f"{opening}\n{svg}\n<figcaption>{escape(caption)}</figcaption>\n</figure>"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of text."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows)
    return f'<div class="scroll"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>'


def details(summary: str, content: str) -> str:
    """Content that opens on a click."""
    return f"<details><summary>{escape(summary)}</summary>\n{content}\n</details>"


def findings(lines: Sequence[str]) -> str:
    """What was noticed in a case's files, folded; nothing where nothing was."""
    return details("What was found in the case", table(["finding"], [[line] for line in lines])) if lines else ""


def notice(text: str, *, good: bool = False) -> str:
    """A boxed sentence: a warning, or good news."""
    return f'<p class="notice{" good" if good else ""}" role="note">{escape(text)}</p>'


def commands(pairs: Iterable[tuple[str, str]]) -> str:
    """What a command does, and the command."""
    return "\n".join(f"<p>{escape(text)}</p>\n<pre><code>{escape(line)}</code></pre>" for text, line in pairs)
