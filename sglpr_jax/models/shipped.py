"""Weights that ship inside the package: a folder for each in sglpr_jax/weights, found by its name."""

from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "weights"
DEFAULT_WEIGHTS = "sglpr"
"""What describes where no weights are named."""


def shipped_weights() -> tuple[str, ...]:
    """The names of the weights that came with the package; each folder has a model card, README.md."""
    return tuple(sorted(path.name for path in FOLDER.glob("[!._]*") if path.is_dir()))


def weights_folder(weights: Path | str) -> Path:
    """The folder that is meant: the name of shipped weights is theirs, everything else a path.

    A folder of one's own with such a name is `./NAME`, as a string. Raises FileNotFoundError, with the names there are,
    where there is neither.
    """
    folder = FOLDER / weights if str(weights) in shipped_weights() else Path(weights)
    if not folder.is_dir():
        names = ", ".join(shipped_weights()) or "there are none"
        raise FileNotFoundError(
            f"{weights}: expected a folder with config.json and model.safetensors, or the name of weights that ship "
            f"with the package ({names}), found neither"
        )
    return folder
