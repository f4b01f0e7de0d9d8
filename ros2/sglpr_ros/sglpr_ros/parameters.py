"""Parameters of the ROS 2 node, which are flags of bin/live. An empty text or 0 stands for a flag without a value."""

from pathlib import Path
from typing import Any

from sglpr_jax.cli.live import LiveCommand
from sglpr_jax.cli.recording import DetectorFlags

DECISION = ("drift_percent", "drift_deg_per_100m", "min_probability", "keyframe_m", "max_places")
"""Flags of the loop detector that are parameters of the node."""
FLAGS = (
    "topic",
    "odometry_topic",
    "reliable",
    "weights",
    "sensor_height",
    "topic_prefix",
    "map_frame",
    "odometry_frame",
    *DECISION,
)
"""Flags of bin/live that are parameters of the node."""
EMPTY = {"topic": "", "odometry_topic": "", "max_places": 0}
"""Values of the parameters that stand for a flag without a value."""
OUT = "sglpr_map"
"""Folder of the map, if the parameter `out` is not set."""


def defaults() -> dict[str, Any]:
    """Return names and default values of the parameters."""
    command = LiveCommand(source="ros2", sinks=("ros2",), out=Path(OUT))
    values = vars(command) | vars(command.decision)
    return {"out": OUT, **{name: EMPTY.get(name, values[name]) for name in FLAGS}}


def command_of(values: dict[str, Any]) -> LiveCommand:
    """Return the command of bin/live with these parameters. Raises ValueError if the height of the sensor is neither a
    number nor "auto"."""
    flags = {name: None if name in EMPTY and not value else value for name, value in values.items()}
    height = flags.pop("sensor_height")
    try:
        height = height if height == "auto" else float(height)
    except ValueError as error:
        raise ValueError(f"sensor_height: expected metres or auto, found {height}") from error
    decision = DetectorFlags(**{name: flags.pop(name) for name in DECISION})
    out = Path(flags.pop("out")).expanduser()
    return LiveCommand(source="ros2", sinks=("ros2",), out=out, sensor_height=height, decision=decision, **flags)
