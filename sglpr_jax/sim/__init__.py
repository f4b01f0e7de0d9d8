"""Simulator of drives through towns: LiDAR scans with poses and semantic labels, without any dataset licence."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sglpr_jax.sim.carriers import CARRIERS, Carrier
    from sglpr_jax.sim.dataset import write_dataset, write_sessions
    from sglpr_jax.sim.drive import PlanarPath, TimedPoses, plan_scan_path, poses_on, read_path
    from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
    from sglpr_jax.sim.repeating import simulate_repeating
    from sglpr_jax.sim.sensor import SENSORS, Sensor, scan
    from sglpr_jax.sim.sessions import Session, plan_sessions
    from sglpr_jax.sim.simulation import Simulated, simulate
    from sglpr_jax.sim.world import World, build_world

_HOME_OF = {
    "CARRIERS": "carriers",
    "Carrier": "carriers",
    "SENSORS": "sensor",
    "PlanarPath": "drive",
    "Sensor": "sensor",
    "Session": "sessions",
    "Simulated": "simulation",
    "SimulatedRecording": "recording",
    "TimedPoses": "drive",
    "World": "world",
    "build_world": "world",
    "plan_scan_path": "drive",
    "plan_sessions": "sessions",
    "poses_on": "drive",
    "read_path": "drive",
    "scan": "sensor",
    "simulate": "simulation",
    "simulate_recording": "recording",
    "simulate_repeating": "repeating",
    "write_dataset": "dataset",
    "write_sessions": "dataset",
}
"""Module of each public name. A module is imported when one of its names is first used."""


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    return globals()[name]


__all__ = [
    "CARRIERS",
    "SENSORS",
    "Carrier",
    "PlanarPath",
    "Sensor",
    "Session",
    "Simulated",
    "SimulatedRecording",
    "TimedPoses",
    "World",
    "build_world",
    "plan_scan_path",
    "plan_sessions",
    "poses_on",
    "read_path",
    "scan",
    "simulate",
    "simulate_recording",
    "simulate_repeating",
    "write_dataset",
    "write_sessions",
]
