"""Descriptor files of a method and a disturbance, taken again only if they were made with the same settings."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

from sglpr_jax.cli.methods import Method
from sglpr_jax.cli.runtime import progress_bar
from sglpr_jax.data import Drive, ImageSequence
from sglpr_jax.data.disturbances import CLEAN, ROTATION, Disturbance
from sglpr_jax.data.disturbed import disturbed
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

SETTINGS = "made_with"
"""The key of a descriptor file's `config` under which they stand."""


def embed_or_reuse(
    path: Path, method: Method, sequence: Drive, disturbance: Disturbance, *, seed: int, batch: int, title: str
) -> DescriptorFile:
    """Describe the disturbed sequence and write the file; read it where it is there already.

    Raises ValueError where it was made with other settings, on other scans or with other weights.
    """
    wanted = _settings(method, sequence, disturbance, seed)
    if path.exists():
        return _checked(path, wanted)
    turned = disturbance == ROTATION
    source = sequence if turned or disturbance == CLEAN else disturbed(sequence, disturbance, seed=seed)
    with progress_bar(title, len(sequence)) as show:
        file = method.embed(source, rotation_seed=seed if turned else None, batch=batch, on_progress=show)
    file = dataclasses.replace(file, config={**file.config, SETTINGS: wanted})
    file.save(path)
    return file


def fingerprint(sequence: Drive) -> str:
    """Name what a sequence holds without reading its scans: their ids, the sizes of their files, the positions."""
    paths = sequence.image_paths if isinstance(sequence, ImageSequence) else sequence.scan_paths
    digest = hashlib.sha256(json.dumps([sequence.ids, [path.stat().st_size for path in paths]]).encode())
    if sequence.positions is not None:
        digest.update(sequence.positions.tobytes())
    return digest.hexdigest()[:16]


def _settings(method: Method, sequence: Drive, disturbance: Disturbance, seed: int) -> dict[str, Any]:
    settings = {
        "seed": None if disturbance == CLEAN else seed,
        "scans": fingerprint(sequence),
        "poses": sequence.pose_source,
        "disturbance": dataclasses.asdict(disturbance),
        "weights": method.weights_hash,
        "method": method.about,
    }
    return json.loads(json.dumps(settings))  # as it will be read again: lists in place of tuples


def _checked(path: Path, wanted: dict[str, Any]) -> DescriptorFile:
    file = DescriptorFile.load(path)
    found = file.config.get(SETTINGS, {})
    for name, value in wanted.items():
        if found.get(name) != value:
            raise ValueError(
                f"{path}: expected descriptors made with {name} {_short(value)}, found {_short(found.get(name))}; "
                "name another --out, or delete the file"
            )
    return file


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:80]}..."
