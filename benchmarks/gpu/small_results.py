"""Results that are few and small, so that they can be copied from a machine from which little can be."""

from pathlib import Path

MOST_FILES = 8
MOST_BYTES = 16 * 10**6
"""Of one file."""
HEADER_BYTES = 10**5
"""Room for what a file of weights has beside its numbers."""


def half_fits(parameters: int) -> bool:
    """Whether so many weights fit one file as float16."""
    return 2 * parameters + HEADER_BYTES <= MOST_BYTES


def told(folder: Path) -> str:
    """One line on what a folder of results holds, and whether that is more than can be counted on to be copied."""
    sizes = {path: path.stat().st_size for path in sorted(folder.rglob("*")) if path.is_file()}
    large = [str(path) for path, size in sizes.items() if size > MOST_BYTES]
    found = f"{folder}: {len(sizes)} files, {sum(sizes.values()) / 1e6:.1f} MB"
    if large or len(sizes) > MOST_FILES:
        found += f" (expected at most {MOST_FILES} files of {MOST_BYTES / 1e6:.0f} MB; too large: {large or 'none'})"
    return found
