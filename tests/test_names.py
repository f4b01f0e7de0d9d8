"""Names of recordings become names of files that lie where they should; tables name only files of their dataset."""

from pathlib import Path

import pytest

from sglpr_jax.files import MOST_BYTES, MOST_SHOWN, file_name, path_inside, printable

HOSTILE = ("../../escaped", "/etc/passwd", "a/b", "a\\b", "", ".", "..", "a\0b", "a\nb")
HOSTILE += ("x" * 2**20, "é" * 100, "\ud800")


@pytest.mark.parametrize("name", ["08", "2012-01-15", "scene 0061", "a.b", ".hidden", "Zürich [2]", "n\udcff", "a:b"])
def test_a_safe_name_is_its_file_name(name):
    assert file_name(name) == name


@pytest.mark.parametrize("name", HOSTILE)
def test_any_other_name_becomes_the_name_of_a_file_in_the_folder(tmp_path, name):
    path = tmp_path / file_name(name)
    path.write_text("")
    assert [*tmp_path.iterdir()] == [path] and len(path.name.encode()) <= MOST_BYTES


def test_different_names_have_different_files():
    names = (*HOSTILE, "a_b", "..-escaped", "x" * (2**20 + 1), "\ud801")
    assert len({file_name(name) for name in names}) == len(names)


def test_a_table_names_files_inside_its_dataset():
    assert path_inside(Path("d"), "samples/a.bin", source=Path("t.json")) == Path("d/samples/a.bin")


@pytest.mark.parametrize("listed", ["/etc/passwd", "../x", "samples/../../x", "", ".", "a\0b", None, 3, ["a"]])
def test_another_path_is_refused_and_the_table_is_named(listed):
    with pytest.raises(ValueError, match=r"t\.json: expected paths of files inside d, found "):
        path_inside(Path("d"), listed, source=Path("t.json"))


def test_a_printed_name_is_one_short_line():
    assert printable("Zürich [2]") == "Zürich [2]"
    assert printable("a\nb\udcff\x1b[31m") == "a\\nb\\udcff\\x1b[31m"
    assert len(printable("x" * 2**20)) == MOST_SHOWN
