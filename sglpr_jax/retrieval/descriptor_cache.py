"""Descriptor files that are reused if they were made with the same settings."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from sglpr_jax.data.corruption import CLEAN, ROTATION
from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import json_in_short
from sglpr_jax.methods.method import Method
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed

SETTINGS = "made_with"
"""Key of the settings in the `config` of a descriptor file."""


def embed_or_reuse(
    path: Path,
    method: Method,
    recording: Recording,
    *,
    rotation_seed: int | None = None,
    batch: int,
    title: str = "",
    progress: Progress = no_progress,
) -> DescriptorFile:
    """Describe a recording and write the descriptor file. If the file exists, read it instead.

    Arguments:
      path: Descriptor file.
      method: Method that describes the scans.
      recording: The scans.
      rotation_seed: With a seed, every scan is first rotated about z by its own random angle.
      batch: Number of scans that a model describes at a time.
      title: Title of the progress display.
      progress: Progress display.

    Raises ValueError if the existing file was made with other settings, scans or weights.
    """
    settings = {
        "seed": rotation_seed,
        "scans": fingerprint(recording),
        "poses": recording.pose_source,
        "corruption": dataclasses.asdict(CLEAN if rotation_seed is None else ROTATION),
        "weights": method.weights_hash,
        "method": method.about,
    }
    settings = json.loads(json.dumps(settings))  # tuples become lists, as in a file
    if path.exists():
        file = DescriptorFile.load(path)
        _check_settings(path, file.config.get(SETTINGS), settings)
        return file
    with progress(title, len(recording)) as show:
        file = embed(method, recording, rotation_seed=rotation_seed, batch=batch, on_progress=show)
    file = dataclasses.replace(file, config={**file.config, SETTINGS: settings})
    file.save(path)
    return file


def _check_settings(path: Path, stored: Any, wanted: dict[str, Any]) -> None:
    """Raise ValueError if the settings stored in a descriptor file differ from the wanted ones. Names the first one."""
    stored = stored if isinstance(stored, dict) else {}
    for name in {**wanted, **stored}:
        if name not in stored or name not in wanted or stored[name] != wanted[name]:
            raise ValueError(
                f"{path}: expected descriptors made with {name} {json_in_short(wanted.get(name))}, found "
                f"{json_in_short(stored.get(name))}; choose another --out, or delete the file"
            )
