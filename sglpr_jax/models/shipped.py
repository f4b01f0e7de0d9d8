"""Weights that ship inside the package. Each has a folder in sglpr_jax/weights and is found by its name."""

from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "weights"
DEFAULT_WEIGHTS = "sglpr"
"""Name of the default weights."""


def shipped_weights() -> tuple[str, ...]:
    """Return the names of the weights that ship with the package. Each folder has a model card, README.md."""
    return tuple(sorted(path.name for path in FOLDER.glob("[!._]*") if path.is_dir()))


def weights_folder(weights: Path | str) -> Path:
    """Return the folder of shipped weights, given their name, or of other weights, given their path.

    A name of shipped weights takes precedence. For your own folder with the same name, pass the string `./NAME`.

    Raises FileNotFoundError if neither exists. The message lists the names.
    """
    folder = FOLDER / weights if str(weights) in shipped_weights() else Path(weights)
    if not folder.is_dir():
        names = ", ".join(shipped_weights()) or "there are none"
        raise FileNotFoundError(
            f"{weights}: expected a folder with config.json and model.safetensors, or the name of weights that ship "
            f"with the package ({names}), found neither"
        )
    return folder
