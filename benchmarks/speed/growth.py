"""How seconds grow with the size of the work: points, pixels, images, places, and queries of a whole sequence.

    python -m benchmarks.speed.growth

An exponent of 1 means that twice the work takes twice as long. Sizes are timed in turn, so that load from outside meets
all alike; of each the least of the repeats counts.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.speed.inputs import random_scans
from sglpr_jax.bev import rasterize
from sglpr_jax.data.density_image import density_image
from sglpr_jax.grid import Grid
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.index import Index

WIDTH = 256
"""Numbers of a descriptor."""
Job = Callable[[], object]


@dataclasses.dataclass(frozen=True)
class Growth:
    """A job for each size of something."""

    what: str
    sizes: Sequence[int]
    job: Callable[[int], Job]
    """Made once for each size, before the time is taken."""
    expected: float = 1.0
    """The exponent of an algorithm that wastes nothing."""


def main(*, preset: str = "sglpr", sectors: int = 64, largest: int = 5, repeats: int = 5) -> None:
    """Print seconds by size, and the exponent between them.

    Args:
        preset: the model that describes.
        sectors: those of the smallest polar image; 0 where the model sees none.
        largest: how often each size is doubled.
        repeats: how often each is timed.
    """
    doubled = 2 ** np.arange(largest + 1)
    table = Table("what grows", "from", "to", "ms at first", "ms at last", "exponent", "last doubling", "aimed at")
    for growth in growths(preset, sectors, doubled):
        seconds = measured(growth, repeats)
        table.add_row(
            growth.what,
            *(f"{size:,}" for size in (growth.sizes[0], growth.sizes[-1])),
            *(f"{1e3 * value:.3g}" for value in (seconds[0], seconds[-1])),
            *(f"{value:.2f}" for value in (exponent(growth.sizes, seconds), exponent(growth.sizes[-2:], seconds[-2:]))),
            f"{growth.expected:g}",
        )
    Console(width=140).print(table)


def growths(preset: str, sectors: int, doubled: np.ndarray) -> list[Growth]:
    """What is looked at."""
    points, places = 15_000 * doubled, 3_125 * doubled
    polar = Growth("sectors of a polar image, describe", sectors * doubled[:4], lambda n: describing(preset, sectors=n))
    return [
        Growth("points of a scan, point counts", points, counting),
        Growth("points of a scan, density image", points, density),
        *([polar] if sectors else []),
        Growth("images of a batch, describe", doubled, lambda n: describing(preset, batch=n)),
        Growth("places of an index, one query", places, asking),
        Growth("frames of a recording, each among those before it", places[:-1] // 4, searching, expected=2.0),
    ]


def counting(n: int) -> Job:
    cloud = jax.device_put(random_scans(n, grid=Grid())[0])
    return lambda: jax.block_until_ready(rasterize(cloud, grid=Grid()))


def density(n: int) -> Job:
    cloud = random_scans(n, grid=Grid(0.4, 152, 152))[0]
    return lambda: density_image(cloud)


def describing(preset: str, *, batch: int = 1, sectors: int | None = None) -> Job:
    config = model_preset(preset)
    if sectors is not None:
        assert config.polar is not None, f"{preset}: expected a polar image"
        config = dataclasses.replace(config, polar=(config.polar[0], sectors))
    params = init(jax.random.key(0), config=config)
    rng = np.random.default_rng(0)
    images = jax.device_put(rng.poisson(1.0, (batch, config.grid.height, config.grid.width)).astype(np.float32))
    return lambda: jax.block_until_ready(describe(params, images))


def asking(n: int) -> Job:
    index = Index.empty(WIDTH)
    index.add(descriptors(n), ids=tuple(map(str, range(n))))
    query = descriptors(1)[0]
    return lambda: index.query(query, 3)


def searching(n: int) -> Job:
    names = tuple(map(str, range(n)))
    file = DescriptorFile("08", names, None, None, descriptors(n), pose_source=None, config={}, weights_hash="")
    index = Index.of(file)
    return lambda: index.query(file.descriptors)


def descriptors(n: int) -> np.ndarray:
    """Random ones of length 1."""
    drawn = np.random.default_rng(0).standard_normal((n, WIDTH), np.float32)
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def measured(growth: Growth, repeats: int) -> list[float]:
    """The least seconds of each size."""
    jobs = [growth.job(int(size)) for size in growth.sizes]
    for job in jobs:
        job()  # compiles
    seconds = np.zeros((repeats, len(jobs)))
    for repeat in track(range(repeats), growth.what, console=Console(stderr=True)):
        for i, job in enumerate(jobs):
            start = time.perf_counter()
            job()
            seconds[repeat, i] = time.perf_counter() - start
    return seconds.min(0).tolist()


def exponent(sizes: Sequence[int], seconds: Sequence[float]) -> float:
    """The slope of seconds over sizes, both as logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


if __name__ == "__main__":
    tyro.cli(main)
