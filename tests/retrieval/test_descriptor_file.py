"""A descriptor file comes back as it was saved, and a file that cannot be one is refused by name."""

import dataclasses
import json

import numpy as np
import pytest

from sglpr_jax.retrieval.descriptor_file import ABOUT, DescriptorFile, check_same_method


@pytest.fixture
def file():
    return DescriptorFile(
        sequence="08",
        ids=("000000", "000007", "ÄÖ-9"),
        positions=np.arange(9.0).reshape(3, 3),
        times=np.array([0.0, 0.1, 0.2]),
        descriptors=np.eye(3, 4, dtype=np.float32),
        pose_source="08/poses.txt (SemanticKITTI)",
        config={"preset": "sglpr", "grid": {"resolution_m": 0.4}},
        weights_hash="abc",
        distance="scan-context",
    )


def assert_same(a, b):
    for field in dataclasses.fields(DescriptorFile):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
        else:
            assert x == y


@pytest.mark.parametrize("absent", [{}, {"times": None}, {"positions": None, "pose_source": None}])
def test_a_file_comes_back_as_it_was_saved(tmp_path, file, absent):
    file = dataclasses.replace(file, **absent)
    file.save(tmp_path / "08.npz")
    assert_same(DescriptorFile.load(tmp_path / "08.npz"), file)
    assert [path.name for path in tmp_path.iterdir()] == ["08.npz"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"times": np.zeros(2)}, r"expected times as float64 \(3\), found float64 \(2,\)"),
        (
            {"ids": (), "positions": np.zeros((0, 3)), "times": None, "descriptors": np.zeros((0, 4), np.float32)},
            "expected at least one scan",
        ),
        ({"ids": ("0", "1", "0")}, "expected a unique id for each scan, found '0' 2 times"),
        ({"times": np.array([0.0, 2.0, 1.0])}, "expected times in ascending order, found an earlier time in row 2"),
    ],
)
def test_what_does_not_fit_together_is_refused(file, change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(file, **change)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"ids": None}, "expected arrays about, ids, descriptors; found descriptors, about"),
        ({"about": np.array("{}")}, "expected format 'sglpr-jax descriptors 2', found None"),
        ({"about": np.array([{"a": 1}], dtype=object)}, "expected a descriptor file .* broken"),
        ({"ids": np.array([["0", "1", "2"]])}, r"expected ids as an array \(n,\) of strings, found <U1 \(1, 3\)"),
        ({"positions": np.zeros((5, 3))}, r"expected positions as float64 \(3, 3\), found float64 \(5, 3\)"),
    ],
)
def test_arrays_that_cannot_be_are_refused(tmp_path, file, changed, message):
    path = tmp_path / "08.npz"
    with pytest.raises(FileNotFoundError, match=r"08\.npz: expected a descriptor file \(\.npz\), found no file"):
        DescriptorFile.load(path)
    about = json.dumps({"format": "sglpr-jax descriptors 2", **{name: getattr(file, name) for name in ABOUT}})
    arrays = {"descriptors": file.descriptors, "ids": np.array(file.ids), "about": np.array(about)} | changed
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=rf"08\.npz.*{message}"):
        DescriptorFile.load(path)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"weights_hash": "f" * 64}, "weights"),
        ({"config": {"method": "sglpr", "model": {"polar": [64, 128]}}}, "model"),
        ({"config": {"method": "sglpr", "model": {"polar": (64, 256)}, "scale": 2}}, "scale"),
    ],
)
def test_descriptors_of_another_method_or_model_cannot_be_compared(file, change, what):
    file = dataclasses.replace(file, config={"method": "sglpr", "model": {"polar": (64, 256)}, "data": "08"})
    check_same_method(file, dataclasses.replace(file, sequence="05", config={**file.config, "data": "05"}))
    with pytest.raises(ValueError, match=rf"of 05, as those of .*, with {what} .*, found "):
        check_same_method(file, dataclasses.replace(file, sequence="05", **change))


def test_a_network_and_its_teacher_can_be_compared(file):
    image, files = {"polar": (64, 256)}, []
    for network in ({"backbone": {"depths": (2, 2)}, "categories": 20}, {"backbone": {"depths": ()}, "categories": 0}):
        files.append(dataclasses.replace(file, config={"method": "sglpr", "model": image | network}))
    check_same_method(*files)
    with pytest.raises(ValueError, match="with model"):
        check_same_method(*(dataclasses.replace(one, weights_hash="") for one in files))


def test_scans_that_are_left_out_are_remembered_by_their_rows(file):
    assert file.is_described.tolist() == [True, True, True]
    fewer = file.only(np.array([True, False, True]))
    assert fewer.ids == ("000000", "ÄÖ-9") and fewer.is_described.tolist() == [True, False, True]
    np.testing.assert_array_equal(fewer.descriptors, file.descriptors[[0, 2]])
    last = dataclasses.replace(fewer, positions=None).only(np.array([False, True]))
    assert (
        last.is_described.tolist() == [False, False, True] and last.times.tolist() == [0.2] and last.positions is None
    )
    for skipped in ("3", [1, 1], [5], [-1], [0.5], {"0": 1}):
        with pytest.raises(ValueError, match="expected row numbers of the skipped scans, found"):
            _ = dataclasses.replace(file, config={"skipped": skipped}).is_described
