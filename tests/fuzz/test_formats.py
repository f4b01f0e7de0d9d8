"""A damaged file is read, or refused by one ValueError or OSError whose line names the file."""

import tempfile
import warnings
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from .damage import damaged
from .formats import FORMATS, Format


def read(format: Format, content: bytes) -> Any:
    """Read a file in a folder with nothing but the files that must lie beside it."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, one in {**format.beside, format.file: content}.items():
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(one)
        before = sorted(Path(folder).rglob("*"))
        try:
            return format.read(Path(folder) / format.file)
        finally:
            assert sorted(Path(folder).rglob("*")) == before, "reading wrote a file"


def refused(format: Format, content: bytes) -> bool:
    """Read a damaged file. Returns whether it is refused; any other error than a good one fails the test."""
    try:
        read(format, content)
    except (ValueError, OSError) as error:
        line, named = str(error), {Path(name).name for name in (*format.beside, format.file)}
        named |= {Path(name).parts[0] for name in format.beside}
        assert any(name in line for name in (*named, tempfile.gettempdir())), line
        assert "expected" in line and "found" in line and "\n" not in line and len(line) < 1500, line
        return True
    return False


@pytest.mark.parametrize("name", FORMATS)
def test_an_intact_file_is_read(name):
    read(FORMATS[name], FORMATS[name].whole)


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_by_name(name, data):
    refused(FORMATS[name], data.draw(damaged(FORMATS[name].whole)))


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("matrix", b"(5, 4)", b"(55555555555555, 4)"),
        ("scored pairs", b"0.5", b"1_0"),
        ("KITTI poses", b"1 0", "１ 0".encode()),
        ("TUM poses", b" 1\n", b" 1e300\n"),
        ("csv poses", b"0.5", b"1_0"),
        ("NCLT ground truth", b"1326652795280148", b"1e30"),
        ("metrics", b'{"step": 2', b'"step": 2'),
        ("loops .jsonl", b"0.9375", b"1" + b"0" * 30),
        ("scan .npy", b"(5, 4), }      ", b"(2147483647, 4)"),
        ("image", b"\x08\0\0\0\0", b"\x08\0\0\0\1"),
        ("bag .mcap", b"uint32 height", b"uint32 heighv"),
        ("bag .bag", b"uint32 height", b"uint32 \n\neight"),
    ],
)
def test_damage_that_was_once_read_is_refused(name, old, new):
    whole = FORMATS[name].whole
    assert old in whole and refused(FORMATS[name], whole.replace(old, new))
