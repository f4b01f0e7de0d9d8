"""A file or folder is written whole or not at all, and errors of writing name it."""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sglpr_jax.files import (
    MOST_BYTES,
    MOST_SHOWN,
    WriteError,
    append_whole,
    check_still_there,
    check_writable,
    exclusive_lock,
    file_name,
    half_written,
    json_in_short,
    path_inside,
    printable,
    raising_write_error,
    read_json,
    remove_half_written,
    replacing,
    write_all,
    write_json,
)

HOSTILE = ("../../escaped", "/etc/passwd", "a/b", "a\\b", "", ".", "..", "a\0b", "a\nb")
HOSTILE += ("x" * 2**20, "é" * 100, "\ud800")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_replaced_at_the_end_of_the_block(tmp_path):
    path = tmp_path / "folder" / "that is missing" / "a.txt"
    for text in ("first", "second"):
        with replacing(path) as temporary:
            assert temporary.parent == path.parent
            temporary.write_text(text)
            assert not path.exists() or path.read_text() == "first"
        assert path.read_text() == text
    assert names(path.parent) == ["a.txt"]


@pytest.mark.parametrize("folder", [False, True])
def test_after_an_error_the_previous_content_stays(tmp_path, folder):
    path = tmp_path / "a"
    write_json(path / "in.json" if folder else path, 1)
    with pytest.raises(KeyboardInterrupt), replacing(path) as temporary:
        write_json(temporary / "in.json" if folder else temporary, 2)
        raise KeyboardInterrupt
    assert (path / "in.json" if folder else path).read_text() == "1\n"
    assert names(tmp_path) == ["a"]


@pytest.mark.parametrize(("keep", "left"), [(False, "new"), (True, "old")])
def test_a_folder_replaces_another_unless_keep_is_set(tmp_path, keep, left):
    path = tmp_path / "weights"
    (path / "old").mkdir(parents=True)
    with replacing(path, keep=keep) as temporary:
        (temporary / "new").mkdir(parents=True)
    assert names(path) == [left] and names(tmp_path) == ["weights"]


def test_all_who_replace_one_folder_at_once_succeed(tmp_path, monkeypatch):
    path, rename = tmp_path / "weights", os.replace

    def rename_and_rest(*names: Path) -> None:
        rename(*names)
        time.sleep(1e-3)  # others come in between

    monkeypatch.setattr(os, "replace", rename_and_rest)

    def write(number: int) -> None:
        with replacing(path) as temporary:
            temporary.mkdir()
            for name in ("a", "b"):
                (temporary / name).write_text(str(number))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(80)))
    assert names(tmp_path) == ["weights"] and names(path) == ["a", "b"]
    assert (path / "a").read_text() == (path / "b").read_text()


def test_a_locked_folder_is_refused_until_it_is_unlocked(tmp_path):
    folder = tmp_path / "new" / "folder"
    with (
        exclusive_lock(folder),
        pytest.raises(BlockingIOError, match=rf"^{folder}: expected .* found another process"),
        exclusive_lock(folder),
    ):
        pass
    with exclusive_lock(folder):
        assert names(folder) == []
    assert names(tmp_path) == []


def test_a_full_disk_is_an_error_that_names_the_file_once(tmp_path, small_files):
    path = tmp_path / "a.bin"
    with (
        small_files(10),
        pytest.raises(WriteError) as raised,
        raising_write_error(tmp_path),
        replacing(path) as temporary,
    ):
        temporary.write_bytes(bytes(100))
    assert str(raised.value) == f"{path}: cannot be written: File too large"
    assert names(tmp_path) == []


def test_what_is_appended_to_a_file_is_whole_or_taken_back(tmp_path, small_files):
    path = tmp_path / "lines"
    path.write_bytes(b"first\n")
    file = os.open(path, os.O_WRONLY | os.O_APPEND)
    with small_files(10), pytest.raises(OSError, match="File too large"):  # the system takes four bytes
        append_whole(file, b"second\n", size=6)
    assert path.read_bytes() == b"first\n"
    append_whole(file, b"third\n", size=6)
    os.close(file)
    assert path.read_bytes() == b"first\nthird\n"


def test_unfinished_files_of_a_killed_process_are_removed(tmp_path):
    (tmp_path / "run" / ".weights.1.tmp" / "in").mkdir(parents=True)
    (tmp_path / "run" / "test").mkdir()
    for name in (".config.json.2.tmp", "test/.a.png.3.tmp", "test/a.png"):
        (tmp_path / "run" / name).write_text("")
    assert [path.name for path in half_written(tmp_path / "run" / "test")] == [".a.png.3.tmp"]
    remove_half_written(tmp_path)
    assert names(tmp_path / "run") == ["test"] and names(tmp_path / "run" / "test") == ["a.png"]


def test_an_unwritable_path_is_an_error_before_work(tmp_path):
    check_writable(tmp_path / "new" / "folder" / "a.npz")
    assert names(tmp_path) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(IsADirectoryError, match="expected a file to write, found a folder"):
        check_writable(tmp_path)
    for write in (check_writable, lambda path: write_json(path, {"a": [1]})):
        with pytest.raises(WriteError, match=rf"{tmp_path}/file/a: cannot be written: (Not a directory|File exists)"):
            write(tmp_path / "file" / "a")


def test_several_files_are_written_together_or_not_at_all(tmp_path):
    def fail(path):
        raise OSError(28, "No space left on device")

    def write(path):
        path.write_text("x")

    assert write_all(tmp_path / "new", {"a": write, "b": write}) == [tmp_path / "new" / "a", tmp_path / "new" / "b"]
    with pytest.raises(WriteError, match=rf"{tmp_path}/c: cannot be written: No space left on device"):
        write_all(tmp_path, {"b": write, "c": fail})
    assert names(tmp_path) == ["new"]


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[" * 100_000, b'{"a": 1, "a": 2}'])
def test_json_that_is_damaged_names_its_file(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ValueError, match=rf"^{tmp_path}/a\.json: expected JSON, found invalid JSON"):
        read_json(tmp_path / "a.json")
    with pytest.raises(FileNotFoundError, match=rf"^{tmp_path}/b\.json: expected a JSON file, found none"):
        read_json(tmp_path / "b.json")


@pytest.mark.parametrize("name", HOSTILE)
def test_a_safe_name_is_its_file_name_and_any_other_becomes_one(tmp_path, name):
    assert file_name("scene 0061") == "scene 0061"
    path = tmp_path / file_name(name)
    path.write_text("")
    assert [*tmp_path.iterdir()] == [path] and len(path.name.encode()) <= MOST_BYTES
    assert all(file_name(other) != path.name for other in (*HOSTILE, "a_b", "..-escaped") if other != name)


@pytest.mark.parametrize("listed", ["/etc/passwd", "samples/../../x", "", "a\0b", None])
def test_a_path_outside_the_dataset_is_refused(listed):
    with pytest.raises(ValueError, match=r"t\.json: expected paths of files inside d, found "):
        path_inside(Path("d"), listed, source=Path("t.json"))


def test_names_and_values_in_messages_are_short_lines():
    assert printable("a\nb\udcff\x1b[31m") == "a\\nb\\udcff\\x1b[31m"
    assert len(printable("x" * 2**20)) == MOST_SHOWN
    assert json_in_short({"kind": "noise", "strength": None}) == '{"kind": "noise", "strength": null}'
    assert len(json_in_short(list(range(100)))) == 80


def test_a_written_file_that_was_removed_is_named(tmp_path):
    write_json(tmp_path / "first.json", {})
    check_still_there(tmp_path / "first.json")
    with pytest.raises(FileNotFoundError, match=r"second\.json: .*found it removed"):
        check_still_there(tmp_path / "first.json", tmp_path / "second.json")
