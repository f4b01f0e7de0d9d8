"""Rasterising one scan, ours against numpy's bincount, and its label image against numpy's assignment."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.speed.inputs import random_scans
from benchmarks.speed.ratio import Contender, Job, alternate, check_equal, report
from sglpr_jax.bev import rasterize, rasterize_labels
from sglpr_jax.grid import Grid


def main(*, points: int = 120_000, size: int = 224, repeats: int = 51, calls: int = 20, threads: int = 2) -> None:
    """Time rasterising on the CPU.

    Args:
        points: points of the cloud.
        size: rows and columns of the image.
        repeats: how often the two are timed against each other.
        calls: images made in one timing.
        threads: threads that each program may use.
    """
    grid = Grid(height=size, width=size)
    cloud, labels = random_scans(points, grid=grid)
    rows = []
    for name, arrays in {"rasterize": (cloud,), "rasterize_labels": (cloud, labels)}.items():
        ours = Contender("JAX", jax_job, name, arrays, grid, calls, threads=threads)
        other = Contender("numpy", numpy_job, name, arrays, grid, calls, threads=threads)
        check_equal(name, ours.run()[0], other.run()[0], tolerance=0)
        rows.append((name, *(alternate((ours, other), repeats=repeats) / calls).T))
    title = f"{points:,} points onto {size} x {size} cells"
    report(title, rows, other="numpy", packages=("jax", "numpy"), threads=threads)


def jax_job(name: str, arrays: tuple[np.ndarray, ...], grid: Grid, calls: int) -> Job:
    """Our function of that name, on arrays that are on the device already."""
    function = functools.partial({"rasterize": rasterize, "rasterize_labels": rasterize_labels}[name], grid=grid)
    on_device = tuple(map(jnp.asarray, arrays))

    def job() -> np.ndarray:
        for _ in range(calls):
            image = jax.block_until_ready(function(*on_device))
        return np.asarray(image)

    return job


def numpy_job(name: str, arrays: tuple[np.ndarray, ...], grid: Grid, calls: int) -> Job:
    """The same in numpy, spared the test for points that are not finite."""
    function = {"rasterize": numpy_rasterize, "rasterize_labels": numpy_rasterize_labels}[name]

    def job() -> np.ndarray:
        for _ in range(calls):
            image = function(*arrays, grid)
        return image

    return job


def numpy_rasterize(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Points per cell."""
    cells, _ = _cells(points, grid)
    return np.bincount(cells, minlength=grid.height * grid.width).reshape(grid.height, grid.width)


def numpy_rasterize_labels(points: np.ndarray, labels: np.ndarray, grid: Grid) -> np.ndarray:
    """The label of the last point of every cell: numpy promises that the last of repeated assignments stays."""
    cells, inside = _cells(points, grid)
    image = np.zeros(grid.height * grid.width, np.int32)
    image[cells] = labels[inside]
    return image.reshape(grid.height, grid.width)


def _cells(points: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The flat cells of the points inside the window, and which points those are."""
    scale = np.float32(1.0 / grid.resolution_m)
    x, y = np.floor(points[:, 0] * scale), np.floor(points[:, 1] * scale)
    inside = (x >= -grid.width // 2) & (x < grid.width // 2) & (y >= -grid.height // 2) & (y < grid.height // 2)
    u = grid.width // 2 + x[inside].astype(np.int32)
    v = grid.height // 2 - y[inside].astype(np.int32) - 1
    return v * grid.width + u, inside


if __name__ == "__main__":
    tyro.cli(main)
