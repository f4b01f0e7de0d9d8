"""Table whose texts are printed as they are. rich would interpret names with brackets as styles, or reject them."""

from typing import Any

from rich.table import Table
from rich.text import Text

from sglpr_jax.files import printable

MOST_SHOWN = 300
"""Maximum number of characters of a line of a cell."""


class PlainTable(Table):
    """Table of plain texts. Control characters are escaped, and very long lines are shortened."""

    def __init__(self, *headers: str, title: str = "", caption: str | None = None):
        super().__init__(title=_plain(title, style="table.title"), caption=caption)
        for header in headers:
            self.add_column(header)

    def add_column(self, header: Any = "", *args: Any, **options: Any) -> None:
        """Add a column whose header may contain any characters. The options are those of rich's `Table.add_column`."""
        super().add_column(_plain(header), *args, **options)

    def add_row(self, *cells: Any, **options: Any) -> None:
        """Add a row of plain texts. The options are those of rich."""
        super().add_row(*map(_plain, cells), **options)


def _plain(text: str, *, style: str = "") -> Text:
    return Text("\n".join(printable(line, most=MOST_SHOWN) for line in text.split("\n")), style=style)
