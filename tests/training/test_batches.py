"""What a batch of a training says of itself."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from recordings import of_scans

from sglpr_jax.data.recording import Recording
from sglpr_jax.training.batches import TupleBatches, tuple_pool


def straight(name: str) -> Recording:
    """Scans that are not read, 2 m apart."""
    positions = np.column_stack([2.0 * np.arange(40), np.zeros((40, 2))])
    return of_scans({Path(f"{name}-{i}.bin"): np.zeros((3, 3)) for i in range(40)}, name=name, positions=positions)


@pytest.mark.parametrize("triplets", [False, True])
def test_the_places_of_both_datasets_are_named(config, triplets):
    config = dataclasses.replace(config, also_tuples=1, also_triplets=triplets)
    main, also = [straight("00")], [straight("town")]
    batches = TupleBatches(main, tuple_pool(main, config), config, also=also)
    pool = tuple_pool(also, config)
    draw = pool.draw if triplets else pool.draw_places
    for step in range(3):
        first, second = batches.places(step).split("; ")
        assert first.startswith("recording 00 frames 00-")
        frames = np.unique(draw(seed=config.seed, step=step, tuples=1))
        assert second == f"recording town frames {' '.join(f'town-{frame}' for frame in frames)}"
