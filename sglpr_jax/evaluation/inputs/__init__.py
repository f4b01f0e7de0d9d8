"""What a method hands in, whatever made it: descriptors, a top-k list or scored pairs, by the kind of file.

    .npz   a descriptor file (`DescriptorFile`)
    .npy   a matrix of descriptors, a row per frame
    text   `query: frame frame ...` is a top-k list, `i j score [label]` a list of scored pairs

Frames are numbered from 0, as the rows of the poses.
"""

from pathlib import Path

from sglpr_jax.data.formats.trajectory import Trajectory
from sglpr_jax.evaluation.inputs.matrix import read_matrix
from sglpr_jax.evaluation.inputs.own_file import read_own_file
from sglpr_jax.evaluation.inputs.pair_list import read_pair_list
from sglpr_jax.evaluation.inputs.top_k_list import is_top_k_list, read_top_k_list
from sglpr_jax.evaluation.protocols import ScoredPairs, Source
from sglpr_jax.retrieval.distances import distance_function

Input = Source | ScoredPairs


def read_input(path: Path, trajectory: Trajectory | None, *, sequence: str, distance: str | None = None) -> Input:
    """Read a file of any kind, to be scored on `trajectory`; None: what the file itself knows is all there is.

    `distance` names how the descriptors of a matrix are compared; None: by L2. The other files say it themselves.
    Raises FileNotFoundError, and ValueError naming the file, what was expected and what was found.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a descriptor file, .npy, top-k list or scored pairs, found none")
    if distance is not None:
        distance_function(distance)
    if path.suffix == ".npy":
        return read_matrix(path, trajectory, sequence=sequence, distance=distance or "l2")
    if distance is not None:
        raise ValueError(f"{path}: expected a .npy beside --distance, found a file that has its own distances")
    if path.suffix == ".npz":
        return read_own_file(path, trajectory)
    if is_top_k_list(path):
        return read_top_k_list(path, trajectory, sequence=sequence)
    return read_pair_list(path, trajectory)


__all__ = ["Input", "read_input"]
