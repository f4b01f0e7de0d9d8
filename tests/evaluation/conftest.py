from collections.abc import Callable

import numpy as np
import pytest
from recordings import of_images

from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.result import LoopSearchResult, Session
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.se3 import transform


@pytest.fixture(scope="session")
def make_file() -> Callable[..., DescriptorFile]:
    """Return a function that makes a descriptor file from positions and descriptors."""

    def make(positions, descriptors, *, times=None, sequence="town"):
        return DescriptorFile(
            sequence=sequence,
            ids=tuple(f"{i:06d}" for i in range(len(descriptors))),
            positions=np.asarray(positions, np.float64),
            times=times,
            descriptors=np.asarray(descriptors, np.float32),
            pose_source="made up",
            config={},
            weights_hash="",
        )

    return make


@pytest.fixture(scope="session")
def two_laps() -> np.ndarray:
    """Return positions (800, 3) of two equal laps around a circle of 200 m radius, at KITTI's 3 m to a frame."""
    angle = np.arange(800) * (2 * np.pi / 400)
    return np.stack([200 * np.cos(angle), 200 * np.sin(angle), np.zeros(800)], axis=1)


@pytest.fixture(scope="session")
def noisy_laps(make_file, two_laps) -> DescriptorFile:
    """Return a descriptor file of two laps. The descriptors are positions with noise."""
    noise = np.random.default_rng(0).normal(scale=0.05, size=(800, 3))
    return make_file(two_laps, two_laps / 200 + noise)


@pytest.fixture(scope="session")
def mistaken(make_file, two_laps) -> DescriptorFile:
    """Return two laps with false matches: frames 500 and 501 with 10 and 11, and 600 (less similar) with 20."""
    descriptors = two_laps / 200
    descriptors[[500, 501]] = descriptors[[10, 11]]
    descriptors[600] = descriptors[20] + [0.001, 0, 0]
    descriptors[700] += [0.01, 0, 0]
    return make_file(two_laps, descriptors, sequence="monday")


@pytest.fixture(scope="session")
def straight() -> np.ndarray:
    """Return positions (800, 3) of a recording without a revisit."""
    return np.arange(800.0)[:, None] * [1.0, 0.0, 0.0]


@pytest.fixture
def found_loops(tmp_path) -> LoopSearchResult:
    """Return the result of a search with three loops among eight images, with odometry."""
    rng = np.random.default_rng(0)
    images = {tmp_path / f"{i:06d}.png": rng.uniform(0, 10, (20, 20)).astype(np.float32) for i in range(8)}
    odometry = np.stack([transform(float(x), 0.0, 0.0) for x in range(8)])
    loops = tuple(LoopClosure(q, q - 4, transform(1.0, 2.0, 0.3), np.eye(6), 0.99 + q / 1000) for q in (5, 6, 7))
    return LoopSearchResult((Session(of_images(images, times=np.arange(8.0)), 8, odometry),), loops)
