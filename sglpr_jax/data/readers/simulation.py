"""Settings of a simulated dataset, which `bin/simulate` writes beside it: mounting of the sensor, and worlds."""

import hashlib
import json
from pathlib import Path
from typing import Any

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.files import naming, read_json

SIMULATION = "simulation.json"
"""File with the settings."""
OF_THE_DRIVE = ("layout", "sensor", "height_m", "submap_m", "aside_m")
"""Settings on which a town does not depend. It depends on the number and the rate of the scans."""


def _settings(root: Path) -> dict[str, Any] | None:
    """Return the settings of a simulated dataset, or None for another dataset."""
    path = root / SIMULATION
    if not path.is_file():
        return None
    settings = read_json(path)
    if not isinstance(settings, dict):
        raise ValueError(f"{path}: expected the settings of a simulated dataset, found {type(settings).__name__}")
    return settings


def simulated_mounting(root: Path) -> Mounting | None:
    """Return the mounting of the sensor of a simulated dataset, or None for a height of 1.73 m (KITTI), and for a
    sensor in a hand, whose scans show it."""
    path, settings = root / SIMULATION, _settings(root)
    if settings is None or is_in_a_hand(root):
        return None
    try:
        height_m = float(settings.get("height_m", settings["sensor"]["height_m"]))
    except (TypeError, KeyError, ValueError) as error:
        expected = "the settings of a simulated dataset with sensor.height_m"
        raise ValueError(f"{path}: expected {expected}, found none") from error
    with naming(path):  # `Mounting` raises ValueError for implausible heights
        return None if height_m == MODEL_HEIGHT_M else Mounting(height_m)


def is_in_a_hand(root: Path) -> bool:
    """Return whether a simulated sensor tilts with the steps of a person, so that no mounting fits all scans."""
    carrier = (_settings(root) or {}).get("carrier")
    return isinstance(carrier, dict) and bool(carrier.get("walks"))


def simulated_world(root: Path, name: str) -> str:
    """Return the name of the world of a simulated recording, or an empty text for another recording.

    Drives along the same route of the same town have the same world, also those by other sensors and carriers, on other
    days and on another lane. Where places repeat, the scenery depends on the carrier, too.
    """
    settings = _settings(root)
    if settings is None:
        return ""
    drives = {key: value for key, value in settings.items() if key.startswith("drive ")}
    town = {key: value for key, value in settings.items() if key not in (*OF_THE_DRIVE, *drives)}
    scenery = settings.get("scenery")
    if not isinstance(scenery, dict) or "repeating" not in scenery:
        town.pop("carrier", None)
    if "sessions" not in settings:
        town["drive"] = [name, drives.get(f"drive {name}")]
    return hashlib.sha256(json.dumps(town, sort_keys=True).encode()).hexdigest()[:16]
