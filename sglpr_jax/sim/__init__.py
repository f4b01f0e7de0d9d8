"""A simulator of drives through a town: LiDAR scans with poses and semantic labels, free of anybody's licence."""

from sglpr_jax.sim.dataset import write_dataset, write_sessions
from sglpr_jax.sim.drive import Drive, Trajectory, plan_trajectory, poses_on, read_path
from sglpr_jax.sim.sensor import SENSORS, Sensor, scan
from sglpr_jax.sim.sequence import SimulatedSequence, simulate_sequence
from sglpr_jax.sim.sessions import Session, plan_sessions
from sglpr_jax.sim.world import World, build_world

__all__ = [
    "SENSORS",
    "Drive",
    "Sensor",
    "Session",
    "SimulatedSequence",
    "Trajectory",
    "World",
    "build_world",
    "plan_sessions",
    "plan_trajectory",
    "poses_on",
    "read_path",
    "scan",
    "simulate_sequence",
    "write_dataset",
    "write_sessions",
]
