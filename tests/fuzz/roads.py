"""Every kind of file that is read: a whole one, how it is read, what it says, and the ways to damage this kind."""

from . import archives, cloud_files, places, rows, run_files, scans_and_images
from .road import Road

ROADS: dict[str, Road] = {
    road.name: road
    for kind in (archives, cloud_files, places, rows, run_files, scans_and_images)
    for road in kind.ROADS
}
"""By its name."""
