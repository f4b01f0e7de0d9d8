"""Descriptors are used again only where they would be made the same."""

import dataclasses

import numpy as np

from sglpr_jax.data import open_recording
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.retrieval.reuse import fingerprint


def test_another_format_mounting_or_position_is_another_recording(tmp_path):
    rng = np.random.default_rng(0)
    for i in range(3):
        rng.uniform(-20, 20, (240, 8)).astype("<f4").tofile(tmp_path / f"{i}.bin")
    one, other = (open_recording(tmp_path, format=format, sensor_height=1.73) for format in ("kitti", "float32x8"))
    moved = dataclasses.replace(one, positions=np.zeros((3, 3)))
    found = {fingerprint(one), fingerprint(other), fingerprint(moved)}
    found.add(fingerprint(dataclasses.replace(one, mounting=Mounting(1.0))))
    assert len(found) == 4
    assert fingerprint(one) == fingerprint(open_recording(tmp_path, format="kitti", sensor_height=1.73))
