"""`describe` as a program: other runtimes give the same descriptors, and what is said of the input is so."""

import dataclasses
import hashlib
import json

import jax
import jax.export
import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.export import input_description, save_program

RNG = np.random.default_rng(0)
TINY = model_preset("tiny")

describe = jax.jit(sglpr_jax.describe)


@pytest.fixture(scope="module")
def params(random_params):
    return random_params(model_preset("sglpr"))


def images(params, n: int) -> np.ndarray:
    grid = params.config.grid
    return RNG.poisson(0.7, (n, grid.height, grid.width)).astype(np.float32)


def scan() -> np.ndarray:
    """Points all over the window, some on the borders of cells, some of them in great numbers at one spot."""
    spread = RNG.uniform([-30, -30, -3], [30, 30, 5], (6000, 3))
    at_borders = np.round(RNG.uniform(-10, 10, (500, 3)) / 0.4) * 0.4
    return np.concatenate([spread, at_borders, np.repeat(spread[:40], 8, axis=0)]).astype(np.float32)


@pytest.mark.slow
def test_stablehlo_gives_the_same_descriptors_for_any_number_of_images(params, tmp_path):
    save_program(params, tmp_path / "out", format="stablehlo")
    program = (tmp_path / "out" / "describe.stablehlo").read_bytes()
    assert b".py" not in program, "it tells where the files of its author lie"
    read = jax.export.deserialize(bytearray(program))
    assert read.platforms == ("cpu", "cuda", "tpu")
    for n in (1, 3):
        bev = images(params, n)
        np.testing.assert_allclose(read.call(bev), describe(params, bev), atol=1e-6)


@pytest.mark.slow
def test_onnx_gives_the_same_descriptors_for_any_number_of_images(params, tmp_path):
    import onnxruntime  # an extra

    save_program(params, tmp_path / "out", format="onnx")
    session = onnxruntime.InferenceSession(tmp_path / "out" / "describe.onnx")
    for n in (1, 3):
        bev = images(params, n)
        (found,) = session.run(None, {"bev": bev})
        np.testing.assert_allclose(found, describe(params, bev), atol=2e-6)
    assert session.get_modelmeta().custom_metadata_map == input_description(params.config)
    checksum = hashlib.sha256((tmp_path / "out" / "describe.onnx").read_bytes()).hexdigest()
    said = json.loads((tmp_path / "out" / "input.json").read_text())
    assert said == input_description(params.config) | {"sha256": checksum}


def test_the_input_of_densities_is_made_as_it_is_said():
    config = model_preset("sglpr-small")
    config = dataclasses.replace(config, image="density")
    said = input_description(config)
    assert "u = 64 + i for i > 0, 63 + i for i < 0" in said["cells"] and "v = 63 - j for j > 0, 64 - j" in said["cells"]
    points = scan()
    points = points[(np.abs(points[:, :2]) < 25).all(1) & (points[:, 2] > -1.2) & (points[:, 2] < 200)]
    edge = 0.1
    while len(np.unique(np.floor(points * np.float32(1 / edge)), axis=0)) > 6000:
        edge += 0.05
    _, voxel = np.unique(np.floor(points * np.float32(1 / edge)), axis=0, return_inverse=True)
    centroids = np.stack([np.bincount(voxel, axis) / np.bincount(voxel) for axis in points.T[:2].astype(np.float64)], 1)
    pairs, n = np.unique(np.trunc(centroids / 0.4).astype(int), axis=0, return_counts=True)
    values = np.round(255 * np.minimum(n, 10) / min(n.max(), 10)) * 10 / 255
    bev = np.zeros((128, 128))
    for (i, j), value in zip(pairs, values, strict=True):
        columns = [63, 64] if i == 0 else [64 + i if i > 0 else 63 + i]
        rows = [63, 64] if j == 0 else [63 - j if j > 0 else 64 - j]
        for v in rows:
            for u in columns:
                if 0 <= u < 128 and 0 <= v < 128:
                    bev[v, u] += value / len(rows) / len(columns)
    np.testing.assert_allclose(bev, sglpr_jax.scan_image(points, config), atol=1e-5)


def test_a_model_that_reads_labels_is_refused(random_params, tmp_path):
    config = dataclasses.replace(TINY, head=dataclasses.replace(TINY.head, input="labels"))
    with pytest.raises(ValueError, match="reads images only, found one that reads labels"):
        save_program(random_params(config), tmp_path / "out", format="stablehlo")
    assert not list(tmp_path.iterdir())
