"""Write the reference pages that follow from the code: the API, commands, configuration, label taxonomies, licences.

`python docs/generate` writes them into docs/reference; bin/docs does so before it builds the manual.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / ".ci")]

from api import api_page  # noqa: E402
from commands import commands_page  # noqa: E402
from configuration import configuration_page  # noqa: E402
from labels import labels_page  # noqa: E402
from licences import licences_page  # noqa: E402


def main() -> None:
    """Write the pages."""
    pages = {"api": api_page(), "commands": commands_page(), "configuration": configuration_page(ROOT)}
    pages |= {"labels": labels_page(), "licences": licences_page()}
    for name, text in pages.items():
        (ROOT / "docs" / "reference" / f"{name}.md").write_text(text)


if __name__ == "__main__":
    main()
