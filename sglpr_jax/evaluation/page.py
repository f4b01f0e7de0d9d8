"""Self-contained HTML pages from sections of texts, tables and pictures, without scripts (`page.html.j2`)."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from jaxtyping import Num
from PIL import Image

from sglpr_jax.evaluation.figures import brightness, write
from sglpr_jax.evaluation.report import TextTable

if TYPE_CHECKING:
    import matplotlib.figure


@dataclass(frozen=True)
class Text:
    """Paragraph of plain text."""

    kind: ClassVar = "text"  # selects the block's HTML in page.html.j2
    text: str
    style: Literal["", "about", "missing"] = ""
    """CSS class. about: a note. missing: why a section is empty or how to fill it."""


@dataclass(frozen=True)
class Picture:
    """Embedded image."""

    kind: ClassVar = "picture"
    uri: str
    """The image itself, as a data URI."""
    name: str
    """Alternative text."""
    width: int | None = None
    """Width on the page in pixels."""
    caption: str = ""


@dataclass(frozen=True)
class PicturePairs:
    """Pairs of images side by side, each with a caption."""

    kind: ClassVar = "pairs"
    pairs: Sequence[tuple[Picture, Picture, str]]


@dataclass(frozen=True)
class Section:
    """Section of a page: a headline and the blocks below it."""

    title: str
    blocks: Sequence[Text | TextTable | Picture | PicturePairs]


def render(title: str, about: str, sections: Sequence[Section]) -> str:
    """Return a page as HTML: the title, a line about the page, and the sections."""
    import jinja2  # imported here, because only pages need it

    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string((resources.files("sglpr_jax.evaluation") / "page.html.j2").read_text())
    return template.render(title=title, about=about, sections=sections)


def missing(text: str) -> Text:
    """Return a line that says why a section is empty or how to fill it."""
    return Text(text, "missing")


def figure_picture(figure: "matplotlib.figure.Figure", name: str, *, caption: str = "") -> Picture:
    """Return a matplotlib figure as an embedded image."""
    stream = io.BytesIO()
    write(figure, stream)
    return Picture(_uri(stream), name, round(figure.get_figwidth() * 96), caption)  # a CSS pixel is 1/96 of an inch


def bev_picture(bev: Num[np.ndarray, "h w"], name: str) -> Picture:
    """Return the point counts of an image seen from above as an embedded grey image."""
    stream = io.BytesIO()
    Image.fromarray((255 * brightness(bev)).astype(np.uint8)).save(stream, format="PNG")
    return Picture(_uri(stream), name)


def _uri(png: io.BytesIO) -> str:
    """Return a PNG file as a data URI."""
    return "data:image/png;base64," + base64.b64encode(png.getvalue()).decode("ascii")
