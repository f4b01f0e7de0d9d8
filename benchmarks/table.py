"""Tables in Markdown that are printed row by row."""

from typing import Any


class Table:
    """Prints its columns, and then each row as soon as it is added."""

    def __init__(self, *columns: str):
        self.add(*columns)
        print("|" + "---|" * len(columns))

    def add(self, *cells: Any) -> None:
        """Print a row."""
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
