"""Reader of a folder of simulated datasets, such as the training set of `bin/simulate --training-set`."""

import dataclasses
from pathlib import Path

from sglpr_jax.data.readers import find_reader, recording_names
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.readers.simulation import SIMULATION, simulated_world
from sglpr_jax.data.recording import Recording


def _names(root: Path) -> tuple[str, ...]:
    """Return DATASET/NAME for each recording of each simulated dataset in the folder."""
    datasets = sorted(path.parent for path in root.glob(f"*/{SIMULATION}"))
    return tuple(f"{dataset.name}/{name}" for dataset in datasets for name in recording_names(dataset))


def _open(root: Path, name: str, options: ReadOptions) -> Recording:
    dataset, _, inner_name = name.partition("/")
    reader = find_reader(root / dataset)[0]
    reader.check_options(root / dataset, options)
    recording = reader.open(root / dataset, inner_name, options)  # the caller adds the mounting
    return dataclasses.replace(recording, name=name, world=simulated_world(root / dataset, inner_name))


READER = Reader(f"DATASET/{SIMULATION} (datasets of bin/simulate)", _names, _open, takes_format=True)
