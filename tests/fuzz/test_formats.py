"""A damaged file is read, or refused by one ValueError or OSError whose line names the file."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from .damage import damaged, read, refused
from .formats import FORMATS

pytestmark = pytest.mark.filterwarnings("ignore")


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
