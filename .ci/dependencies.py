"""What pyproject.toml names, and what that needs: versions for pip's -c.

python .ci/dependencies.py lowest    the lowest versions that pyproject.toml allows
python .ci/dependencies.py lock      the versions installed here, for .ci/constraints.txt
"""

import contextlib
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = tuple(PROJECT["optional-dependencies"])


def named(extra: str | None = None) -> list[Requirement]:
    """What pyproject.toml names as required, or in an extra, but for other extras of this package."""
    lines = PROJECT["dependencies"] if extra is None else PROJECT["optional-dependencies"][extra]
    return [need for need in map(Requirement, lines) if canonicalize_name(need.name) != PROJECT["name"]]


def all_named() -> list[Requirement]:
    """What is required, and all extras."""
    return [need for extra in (None, *EXTRAS) for need in named(extra)]


def lowest(need: Requirement) -> str:
    """The lowest version that is allowed."""
    (bound,) = (one.version for one in need.specifier if one.operator in (">=", "=="))
    return bound


def installed(needs: Iterable[Requirement]) -> dict[str, metadata.Distribution]:
    """What is installed of these packages and of all that they need on this system, by name."""
    seen, waiting, found = set[tuple[str, frozenset[str]]](), list(needs), {}
    while waiting:
        need = waiting.pop()
        asked = canonicalize_name(need.name), frozenset(need.extras)
        if asked not in seen:
            seen.add(asked)
            with contextlib.suppress(metadata.PackageNotFoundError):  # of an extra that is not installed here
                found[asked[0]] = metadata.distribution(need.name)
                waiting += _needs(found[asked[0]], need.extras)
    return dict(sorted(found.items()))


def _needs(package: metadata.Distribution, extras: Iterable[str]) -> Iterator[Requirement]:
    """What a package needs, with some of its extras."""
    for need in map(Requirement, package.requires or ()):
        if need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield need


def main(what: str) -> None:
    """Print NAME==VERSION of each."""
    if what == "lowest":
        versions = {canonicalize_name(need.name): lowest(need) for need in all_named()}
    else:
        versions = {name: package.version for name, package in installed(all_named()).items()}
    print("\n".join(f"{name}=={version}" for name, version in sorted(versions.items())))


if __name__ == "__main__":
    main(*sys.argv[1:])
