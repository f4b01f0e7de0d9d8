"""The page of licences: what is installed beside this package, and under which terms its authors say that it stands."""

from importlib import metadata

from dependencies import EXTRAS, installed, named
from fields import table

HEAD = """# Licences

This package is under the Apache licence 2.0. These are the packages that it needs, and those that they need, with the
licence that each names in its own metadata. The page is made from what is installed where the manual is built; packages
for other systems, and extras that are not installed there, are missing.

## Always
"""


def licences_page() -> str:
    """The required packages, then what each extra adds to them."""
    required = installed(named())
    parts = [HEAD, _table(required)]
    for extra in EXTRAS:
        more = {name: one for name, one in installed(named(extra)).items() if name not in required}
        if more:
            parts += [f"## With the extra `{extra}`\n", _table(more)]
    return "\n".join(parts)


def licence_of(package: metadata.Distribution) -> str:
    """What a package says of its licence: an SPDX expression, else its classifiers, else the first line of the text."""
    about = package.metadata
    classified = [line.rpartition(" :: ")[2] for line in about.get_all("Classifier", []) if line.startswith("License")]
    free_text = (about.get("License") or "").strip().partition("\n")[0]
    return about.get("License-Expression") or ", ".join(classified) or free_text or "none named"


def _table(packages: dict[str, metadata.Distribution]) -> str:
    rows = [(name, one.version, licence_of(one)) for name, one in packages.items()]
    return table(("package", "version", "licence"), rows) + "\n"
