"""Self-contained HTML: style and images are embedded, and the page has no scripts."""

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Num
from PIL import Image

from sglpr_jax.evaluation.figures import brightness, write

if TYPE_CHECKING:
    import matplotlib.figure

STYLE = """
body { max-width: 120rem; margin: 2rem auto; padding: 0 1rem; color: #222; background: #fff;
  font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; margin-bottom: 0; }
h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd; }
p { max-width: 72rem; }
.about, .missing, figcaption { color: #666; }
.missing { font-style: italic; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { padding: 0.35rem 0.7rem; text-align: left; vertical-align: top; border-bottom: 1px solid #e4e4e4;
  white-space: pre-line; overflow-wrap: break-word; }
th { background: #f5f5f5; }
td.number { font-variant-numeric: tabular-nums; white-space: pre; }
figure { margin: 0.8rem 1.6rem 0.8rem 0; max-width: 100%; display: inline-block; vertical-align: top; }
figure img { max-width: 100%; }
.pairs { display: flex; flex-wrap: wrap; gap: 1.2rem 2rem; }
.pairs figure { width: 21rem; margin: 0; }
.pairs .two { display: flex; gap: 0.4rem; }
.pairs img { width: 50%; image-rendering: pixelated; background: #000; }
figcaption { font-size: 0.85rem; }
"""


@dataclass(frozen=True)
class Section:
    """Section of a page: a headline and the HTML below it."""

    title: str
    body: str


def document(title: str, about: str, sections: Iterable[Section]) -> str:
    """Return a page of these sections as HTML."""
    parts = "\n".join(f"<section>\n<h2>{escape(part.title)}</h2>\n{part.body}\n</section>" for part in sections)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width">\n<title>{escape(title)}</title>\n'
        f"<style>{STYLE}</style>\n</head>\n<body>\n<h1>{escape(title)}</h1>\n"
        f'<p class="about">{escape(about)}</p>\n{parts}\n</body>\n</html>\n'
    )


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Sequence[str] = ()) -> str:
    """Return an HTML table of plain text. Columns named in `numbers` are typeset as numbers."""
    styles = [' class="number"' if name in numbers else "" for name in header]
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "\n".join(
        "<tr>" + "".join(f"<td{style}>{escape(cell)}</td>" for style, cell in zip(styles, row, strict=True)) + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def paragraph(text: str) -> str:
    """Return an HTML paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def missing(text: str) -> str:
    """Return a line that says why a section is empty or how to fill it."""
    return f'<p class="missing">{escape(text)}</p>'


def figure_html(figure: "matplotlib.figure.Figure", name: str, *, caption: str = "") -> str:
    """Return a matplotlib figure as an embedded image. `name` is the alternative text."""
    stream = io.BytesIO()
    write(figure, stream)
    width = round(figure.get_figwidth() * 96)  # a CSS pixel is 1/96 of an inch
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    picture = f'<img src="{_uri(stream)}" width="{width}" alt="{escape(name)}">'
    return f'<figure style="width: {width}px">{picture}{below}</figure>'  # the width limits a long caption


def bev_html(bev: Num[np.ndarray, "h w"], name: str) -> str:
    """Return point counts as an embedded grey image. `name` is the alternative text."""
    stream = io.BytesIO()
    Image.fromarray((255 * brightness(bev)).astype(np.uint8)).save(stream, format="PNG")
    return f'<img src="{_uri(stream)}" alt="{escape(name)}">'


def _uri(png: io.BytesIO) -> str:
    return "data:image/png;base64," + base64.b64encode(png.getvalue()).decode("ascii")
