"""Arrays as safetensors: what the library reads, in the same bytes each time."""

import numpy as np
import safetensors
import safetensors.numpy

from sglpr_jax.data.formats.tensors import tensors_as_bytes

ARRAYS = {"b": np.arange(6, dtype=np.float16).reshape(2, 3), "a": np.arange(5), "empty": np.zeros((0, 4), np.uint8)}
METADATA = {name: f"of {name}" for name in ("z", "y", "x", "w", "v")}


def test_arrays_and_metadata_come_back(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(tensors_as_bytes(ARRAYS, METADATA))
    found = safetensors.numpy.load_file(path)
    assert found.keys() == ARRAYS.keys()
    for name, values in ARRAYS.items():
        np.testing.assert_array_equal(found[name], values, strict=True)
    with safetensors.safe_open(path, framework="np") as file:
        assert file.metadata() == METADATA


def test_the_order_of_metadata_changes_nothing():
    backwards = dict(reversed(METADATA.items()))
    contents = {tensors_as_bytes(ARRAYS, given) for given in (METADATA, backwards) for _ in range(8)}
    assert len(contents) == 1
