"""Every kind of file that is read: a whole one, how it is read, what it says, and the ways to damage this kind."""

from . import (
    answers,
    archives,
    cloud_files,
    continued,
    fleet,
    places,
    rows,
    run_files,
    scans_and_images,
    semantic,
    tables,
)
from .road import FolderRoad, Road

KINDS = (archives, cloud_files, places, rows, run_files, scans_and_images, tables, continued, answers, fleet, semantic)
ROADS: dict[str, Road | FolderRoad] = {road.name: road for kind in KINDS for road in kind.ROADS}
"""By its name."""
FILE_ROADS = {name: road for name, road in ROADS.items() if isinstance(road, Road)}
"""Those that read one file."""
