"""Readers: whatever lies on disk becomes a `ScanSequence` or an `ImageSequence`."""

from pathlib import Path

from sglpr_jax.data import bev_images, folder, kitti, nclt
from sglpr_jax.data.kitti import PoseChoice
from sglpr_jax.data.scan_files import ScanFormat, read_scan
from sglpr_jax.data.sequence import Drive, ImageSequence, ScanSequence

__all__ = ["Drive", "ImageSequence", "ScanSequence", "open_sequence", "read_scan", "sequence_names"]


def sequence_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root`, in order: those of the first layout that fits.

    The layouts are KITTI's (`kitti.py`), ready-made BEV images (`bev_images.py`), NCLT's (`nclt.py`), and a folder of
    scans (`folder.py`), which is one sequence with the folder's name. Raises FileNotFoundError where `root` has none.
    """
    layouts = (kitti, bev_images, nclt, folder)
    names = next(filter(None, (layout.sequence_names(root) for layout in layouts)), ())
    if not names:
        found = "nothing of the kind" if root.is_dir() else "no such folder"
        raise FileNotFoundError(
            f"{root}: expected sequences/NN/velodyne/*.bin (KITTI), NN/imgs/*.png with NN/pose.txt (BEV images),"
            f" YYYY-MM-DD/velodyne_sync/*.bin (NCLT) or single scans (*.bin, *.pcd), found {found}"
        )
    return names


def open_sequence(
    root: Path, name: str | None = None, *, poses: PoseChoice = "auto", format: ScanFormat = "auto"
) -> Drive:
    """Open one sequence of `root`, which may have any of the layouts of `sequence_names`.

    Without `name`, `root` must have one sequence. `poses` chooses between the two pose files of KITTI's layout and is
    not used for the others; `format` tells what the scans of a plain folder are. Raises FileNotFoundError where
    something is missing, ValueError where a file is malformed.
    """
    names = sequence_names(root)
    if name is None and len(names) == 1:
        name = names[0]
    if name not in names:
        asked = "the name of one sequence" if name is None else f"sequence {name!r}"
        raise FileNotFoundError(f"{root}: expected {asked}, found {', '.join(names)}")
    if name in kitti.sequence_names(root):
        return kitti.open_sequence(root, name, poses=poses)
    if name in bev_images.sequence_names(root):
        return bev_images.open_sequence(root, name)
    if name in nclt.sequence_names(root):
        return nclt.open_sequence(root, name)
    return folder.open_sequence(root, format=format)
