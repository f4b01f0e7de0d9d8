"""Learned methods of other publications describe each record for itself; what they may not return is an error."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from recordings import of_images, of_scans

from sglpr_jax.bev import rotate_image
from sglpr_jax.data.views import rotated
from sglpr_jax.methods.method import RecordMethod
from sglpr_jax.retrieval.embed import embed

SCANS = 11
RNG = np.random.default_rng(0)
CLOUDS = {Path(f"{i:06d}.bin"): RNG.uniform(-9, 9, (30 + i, 3)).astype(np.float32) for i in range(SCANS)}
PICTURES = {Path(f"{i:06d}.png"): RNG.uniform(0, 10, (12, 12)).astype(np.float32) for i in range(SCANS)}


def mean_point(record):
    return record.upright_points.mean(axis=0)


def method(prepare=mean_point, describe=lambda inputs: inputs, takes="points") -> RecordMethod:
    return RecordMethod(prepare, describe, takes, "l2", {"method": "mine"}, "hash")


@pytest.fixture
def scans():
    return of_scans(CLOUDS, positions=np.zeros((SCANS, 3)), pose_source="this test")


@pytest.mark.parametrize("batch", [1, 4, 16])
def test_every_scan_gets_its_own_descriptor(scans, batch):
    sizes = []

    def describe(inputs):
        sizes.append(len(inputs))
        return inputs

    file = embed(method(describe=describe), scans, batch=batch)
    np.testing.assert_array_equal(file.descriptors, [cloud.mean(axis=0) for cloud in CLOUDS.values()])
    assert file.ids == scans.ids and file.weights_hash == "hash" and file.distance == "l2"
    assert file.config["method"] == "mine" and set(sizes) == {batch}


def test_scans_and_images_are_rotated(scans):
    angles = np.random.default_rng(3).uniform(0, 2 * np.pi, SCANS)
    file = embed(method(), scans, rotation_seed=3)
    expected = [rotated(cloud, angle).mean(axis=0) for cloud, angle in zip(CLOUDS.values(), angles, strict=True)]
    np.testing.assert_allclose(file.descriptors, expected, atol=1e-5)
    pictures = of_images(PICTURES, name="06", positions=np.zeros((SCANS, 3)), pose_source="this test")
    on_images = method(prepare=lambda record: record.image.reshape(-1), takes="images")
    found = embed(on_images, pictures, rotation_seed=3).descriptors
    expected = [
        np.asarray(rotate_image(image, np.float32(angle)))
        for image, angle in zip(PICTURES.values(), angles, strict=True)
    ]
    np.testing.assert_allclose(found, np.reshape(expected, (SCANS, -1)), atol=1e-4)


def test_a_bad_scan_is_skipped_and_named(scans):
    def prepare(record):
        if "000004" in record.name or "000010" in record.name:
            raise ValueError("unreadable")
        return mean_point(record)

    skipped = []
    file = embed(method(prepare), scans, batch=4, on_bad_scan=lambda scan, error: skipped.append(scan))
    assert skipped == ["000004", "000010"] and file.ids == tuple(i for i in scans.ids if i not in skipped)
    expected = [cloud.mean(axis=0) for path, cloud in CLOUDS.items() if path.stem not in skipped]
    np.testing.assert_array_equal(file.descriptors, expected)
    with pytest.raises(ValueError, match="unreadable"):
        embed(method(prepare), scans)


@pytest.mark.parametrize(
    ("value", "words"), [(np.nan, "values that are not finite"), (np.inf, "not finite"), (0, "only zeros")]
)
def test_invalid_descriptors_are_one_line_errors(scans, value, words):
    def prepare(record):
        return np.full(3, value if "000006" in record.name else 1, np.float32)

    with pytest.raises(ValueError, match=f"^mine: expected a descriptor of scan 000006 of sequence .*{words}$"):
        embed(method(prepare), scans)


def test_other_lengths_from_scan_to_scan_are_errors(scans):
    odd = method(lambda record: np.ones(4 if "000006" in record.name else 3, np.float32))
    with pytest.raises(ValueError, match=r"mine: expected an input \(3,\) of scan 000006 .*found \(4,\)"):
        embed(odd, scans)
    calls = []

    def longer(inputs):
        calls.append(1)
        return np.ones((len(inputs), 3 + len(calls)), np.float32)

    with pytest.raises(ValueError, match=r"mine: expected 4 numbers of scan 000004 .*found 5"):
        embed(method(describe=longer), scans, batch=4)
    with pytest.raises(ValueError, match="mine: expected 8 descriptors"):
        embed(method(describe=lambda inputs: np.ones((len(inputs), 2, 2))), scans)


def test_missing_points_and_labels_are_errors(scans):
    pictures = of_images(PICTURES, name="06", positions=np.zeros((SCANS, 3)), pose_source="this test")
    with pytest.raises(ValueError, match="mine needs points, found only images in sequence 06"):
        embed(method(), pictures)
    with pytest.raises(ValueError, match="mine needs labels beside the scans, found none"):
        embed(dataclasses.replace(method(), takes="labelled points"), scans)
