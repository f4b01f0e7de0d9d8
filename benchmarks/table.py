"""Tables in Markdown that are printed row by row."""

from typing import Any


class Table:
    """Markdown table that prints its header first, and each row when it is added."""

    def __init__(self, *columns: str):
        self.add(*columns)
        print("|" + "---|" * len(columns))

    def add(self, *cells: Any) -> None:
        """Prints a row."""
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
