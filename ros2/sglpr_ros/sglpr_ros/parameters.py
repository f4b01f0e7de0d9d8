"""Parameters of the node: flags of bin/live, with types of ROS. An empty text or 0 is a flag without a value."""

from pathlib import Path
from typing import Any

from sglpr_jax.cli.live import LiveCommand

FLAGS = (
    "topic",
    "odometry_topic",
    "reliable",
    "weights",
    "sensor_height",
    "topic_prefix",
    "map_frame",
    "odometry_frame",
    "drift_percent",
    "drift_deg_per_100m",
    "min_probability",
    "keyframe_m",
    "max_places",
)
"""Flags that are parameters."""
EMPTY = {"topic": "", "odometry_topic": "", "max_places": 0}
"""Values of the parameters whose flags have none by default."""
OUT = "sglpr_map"
"""Folder of the map, if the parameter `out` is not set."""


def defaults() -> dict[str, Any]:
    """Names and default values of the parameters."""
    usual = LiveCommand(source="ros2", sinks=("ros2",), out=Path(OUT))
    return {"out": OUT, **{name: EMPTY.get(name, getattr(usual, name)) for name in FLAGS}}


def command_of(values: dict[str, Any]) -> LiveCommand:
    """The command of bin/live with these parameters.

    Raises ValueError if the height of the sensor is invalid.
    """
    found = {name: None if name in EMPTY and not value else value for name, value in values.items()}
    height = found.pop("sensor_height")
    try:
        height = height if height == "auto" else float(height)
    except ValueError as error:
        raise ValueError(f"sensor_height: expected metres or auto, found {height}") from error
    return LiveCommand(
        source="ros2", sinks=("ros2",), out=Path(found.pop("out")).expanduser(), sensor_height=height, **found
    )
