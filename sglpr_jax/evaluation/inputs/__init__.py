"""Readers of the inputs of an evaluation: descriptors, a top-k list or scored pairs of any method.

    .npz   a descriptor file (`DescriptorFile`)
    .npy   a matrix of descriptors, one row per frame
    text   a top-k list has lines `query: frame frame ...`, a list of scored pairs `i j score [label]`

Frames are numbered from 0, in the order of the poses.
"""

from pathlib import Path

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.evaluation.inputs.matrix import read_matrix
from sglpr_jax.evaluation.inputs.own_file import read_own_file
from sglpr_jax.evaluation.inputs.pair_list import read_pair_list
from sglpr_jax.evaluation.inputs.top_k_list import is_top_k_list, read_top_k_list
from sglpr_jax.evaluation.protocols.source import ScoredPairs, Source
from sglpr_jax.retrieval.distances import distance_function

Input = Source | ScoredPairs


def read_input(path: Path, trajectory: Trajectory | None, *, sequence: str, distance: str | None = None) -> Input:
    """Read an input file of any kind.

    Arguments:
      path: File to read.
      trajectory: Positions and times of the frames. If None, only those in the file are used.
      sequence: Name of the sequence, for files that do not contain it.
      distance: Name of the distance between the descriptors of a .npy file, L2 by default. Other files define their
        own distance.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is invalid or does not fit the other arguments. The message names the file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a descriptor file, .npy, top-k list or scored pairs, found none")
    if distance is not None:
        distance_function(distance)
    if path.suffix == ".npy":
        return read_matrix(path, trajectory, sequence=sequence, distance=distance or "l2")
    if distance is not None:
        raise ValueError(f"{path}: expected a .npy beside --distance, found a file that defines its own distance")
    if path.suffix == ".npz":
        return read_own_file(path, trajectory)
    if is_top_k_list(path):
        return read_top_k_list(path, trajectory, sequence=sequence)
    return read_pair_list(path, trajectory)


__all__ = ["Input", "read_input"]
