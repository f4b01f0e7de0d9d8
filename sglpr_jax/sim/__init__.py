"""A simulator of drives through a town: LiDAR scans with poses and semantic labels, free of anybody's licence."""

from sglpr_jax.sim.dataset import write_dataset, write_sessions
from sglpr_jax.sim.drive import PlanarPath, TimedPoses, plan_scan_path, poses_on, read_path
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.sensor import SENSORS, Sensor, scan
from sglpr_jax.sim.sessions import Session, plan_sessions
from sglpr_jax.sim.simulation import Simulated, simulate
from sglpr_jax.sim.world import World, build_world

__all__ = [
    "SENSORS",
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
    "write_dataset",
    "write_sessions",
]
