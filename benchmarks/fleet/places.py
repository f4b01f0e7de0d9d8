"""Places for a large index: descriptors of simulated drives, new places between their scans, random directions.

python -m benchmarks.fleet.places --out drives.npz
"""

from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float32

import sglpr_jax
from sglpr_jax.numpy_files import read_arrays

ROUTES = ("00", "02", "05", "06", "08")
"""Routes that are driven in every town."""


def main(*, out: Path, towns: int = 2, scans: int = 300, weights: str = "sglpr") -> None:
    """Describe drives through simulated towns, one after the other along each route.

    Args:
        out: file (.npz) of the descriptors, an array for each drive.
        towns: number of towns, with seeds from 700 on.
        scans: scans of a drive.
        weights: shipped weights.
    """
    from sglpr_jax.sim.recording import simulate_recording  # slow imports that processes with drawn places do not need
    from sglpr_jax.sim.sensor import HDL64E

    params = sglpr_jax.load(weights)
    drives = {}
    for seed in range(700, 700 + towns):
        for route in ROUTES:
            recording = simulate_recording(route, scans=scans, seed=seed, sensor=HDL64E)
            drives[f"{seed}-{route}"] = sglpr_jax.embed(params, recording).descriptors
            print(f"{seed}-{route}: {len(drives[f'{seed}-{route}'])} descriptors", flush=True)
    np.savez(out, **drives)


class Drives:
    """Draws places that resemble those of the drives in a file.

    A drawn place lies at a random fraction of the way between two successive scans. Noise moves it like the differences
    between successive scans: it has their covariance, times `spread` squared.
    """

    def __init__(self, path: Path, *, spread: float = 1.0):
        drives = read_arrays(path, expected="descriptors of drives (.npz)").values()
        self.first = np.concatenate([drive[:-1] for drive in drives])
        self.step = np.concatenate([np.diff(drive, axis=0) for drive in drives])
        self.spread = spread

    def near(
        self, places: Float32[np.ndarray, "n d"], rng: np.random.Generator, *, spread: float | None = None
    ) -> Float32[np.ndarray, "n d"]:
        """Descriptors of revisits of places: moved by noise."""
        rows = rng.integers(len(self.step), size=(4, len(places)))
        weights = rng.standard_normal((4, len(places), 1), dtype=np.float32) / 2
        noise = sum(weight * self.step[row] for weight, row in zip(weights, rows, strict=True))
        return _unit(places + (self.spread if spread is None else spread) * noise)

    def draw(self, n: int, rng: np.random.Generator) -> Float32[np.ndarray, "n d"]:
        """Descriptors of `n` new places."""
        rows, share = rng.integers(len(self.first), size=n), rng.random((n, 1), dtype=np.float32)
        return self.near(self.first[rows] + share * self.step[rows], rng)


def random_places(n: int, width: int, rng: np.random.Generator) -> Float32[np.ndarray, "n d"]:
    """Random directions."""
    return _unit(rng.standard_normal((n, width), dtype=np.float32))


def _unit(rows: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "n d"]:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


if __name__ == "__main__":
    tyro.cli(main)
