"""A small simulator of drives through a town: what bin/demo and bin/train use where no dataset is named."""

from sglpr_jax.sim.dataset import write_dataset
from sglpr_jax.sim.drive import Drive, plan_drive
from sglpr_jax.sim.sensor import Sensor, scan
from sglpr_jax.sim.world import World, build_world

__all__ = ["Drive", "Sensor", "World", "build_world", "plan_drive", "scan", "write_dataset"]
