"""Say which evidence is missing where places repeat: how well the right place of each revisit fits, and a lookalike.

    python -m benchmarks.quality.repeating_scans --seeds 13 --out build/test
    python -m benchmarks.quality.missing_evidence build/test --out build/missing.png

For each scenery the table has the revisits, the share of them that was compared with the right place, the share for
which this place fits best, the best wrong fit over the right one (median), and the stated uncertainty of the position
along the least certain direction. The picture shows a typical revisit of each scenery over its right place and over the
best lookalike: cells of both are white, those of the query alone are cyan and those of the place red.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from rich.table import Table

import sglpr_jax
from benchmarks.quality.drives import RenderedDrive, compared, pose_errors, read
from benchmarks.quality.repeating import REVISIT_M, WAY_M, revisits
from sglpr_jax.evaluation import figures
from sglpr_jax.loops.compared_image import within_reach
from sglpr_jax.loops.comparison import Fits
from sglpr_jax.loops.config import VerificationConfig
from sglpr_jax.loops.overlay import overlaid
from sglpr_jax.loops.transforms import transform
from sglpr_jax.loops.verification import refined

VERIFICATION = VerificationConfig()


class Revisit(NamedTuple):
    """A scan at a place that was seen before, with the best fit at its true pose and the best at a wrong one."""

    drive: RenderedDrive
    query: int
    fits: Fits
    right: int | None
    """Row of the fit. None if the scan was not compared with this place."""
    wrong: int | None

    @property
    def ratio(self) -> float:
        """Correlation of the best wrong fit over that of the right one."""
        if self.right is None or self.wrong is None:
            return 0.0 if self.right is not None else np.inf
        return float(self.fits.peaks.correlation[self.wrong] / self.fits.peaks.correlation[self.right])

    @property
    def along_m(self) -> float:
        """Stated uncertainty of the right pose along its least certain direction, in metres."""
        if self.right is None:
            return np.nan
        images = self.image(self.query), self.image(int(self.fits.frames[self.right]))
        found = refined(*images, self.fits.peaks.one(self.right), config=VERIFICATION)
        return float(jax.device_get(found.along_m)) / self.drive.scale

    def image(self, frame: int) -> np.ndarray:
        """Compared cells of a scan."""
        return np.asarray(within_reach(self.drive.seen[frame].image, VERIFICATION))

    def overlay(self, row: int) -> Float[np.ndarray, "n n 3"]:
        """The scan over the place of a fit, at the pose of this fit."""
        peak = self.fits.peaks.one(row)
        pose = transform(float(peak.x), float(peak.y), float(peak.yaw))
        return overlaid(self.image(self.query), self.image(int(self.fits.frames[row])), pose)


def main(
    drives: tyro.conf.Positional[Path],
    *,
    sceneries: tuple[str, ...] = (),
    sensor: str = "hdl64e",
    out: Path | None = None,
    weights: str = "sglpr",
) -> None:
    """Print the table, and draw the picture.

    Args:
        drives: folder of `repeating_scans.py`.
        sceneries: those to show; without them all.
        sensor: that of the drives.
        out: picture to write; its suffix is the format (extra viz).
        weights: the model that described the scans.
    """
    params, found = sglpr_jax.load(weights), dict[str, list[Revisit]]()
    for path in track(sorted(drives.glob(f"*-{sensor}-*.npz")), description="compare"):
        drive = read(path)
        if not sceneries or drive.about["scenery"] in sceneries:
            frames = [one.fits for one in compared(drive, params, drives / "compared")]
            found.setdefault(drive.about["scenery"], []).extend(_revisits(drive, frames))
    table = Table("scenery", "revisits", "compared", "fits best", "lookalike", "along (m)")
    shown = {}
    for scenery, some in found.items():
        seen = sorted((one for one in some if one.right is not None), key=lambda one: one.ratio)
        if not seen:
            table.add_row(scenery, str(len(some)), "0.00", "", "", "")
            continue
        ratios = [one.ratio for one in seen]
        shown[scenery] = seen[len(seen) // 2]
        best, along_m = np.mean(np.array(ratios) < 1), np.median([one.along_m for one in seen[:: len(seen) // 20 + 1]])
        shares = (len(seen) / len(some), best, np.median(ratios), along_m)
        table.add_row(scenery, str(len(some)), *(f"{share:.2f}" for share in shares))
    Console().print(table)
    if out is not None:
        _draw(shown, out)


def _revisits(drive: RenderedDrive, frames: Sequence[Fits]) -> list[Revisit]:
    poses, found = drive.world_from_lidar, []
    for query in np.flatnonzero(revisits(poses[:, :3, 3], REVISIT_M * drive.scale, WAY_M * drive.scale)).tolist():
        fits = frames[query]
        peaks = zip(fits.peaks.x, fits.peaks.y, fits.peaks.yaw, strict=True)
        each = np.array([transform(*map(float, peak)) for peak in peaks]).reshape(-1, 4, 4)
        errors = pose_errors([(query, frame) for frame in fits.frames.tolist()], each, poses)
        way_m = np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1))
        before = way_m[fits.frames] <= way_m[query] - WAY_M * drive.scale
        rows = (_best(fits, errors.right & before), _best(fits, errors.wrong))
        found.append(Revisit(drive, query, fits, *rows))
    return found


def _best(fits: Fits, allowed: np.ndarray) -> int | None:
    return int(np.argmax(np.where(allowed, fits.peaks.correlation, -1.0))) if allowed.any() else None


def _draw(shown: dict[str, Revisit], out: Path) -> None:
    """A column for each scenery: the right place above, the lookalike below."""
    figure = figures.new_figure(1.9 * len(shown), 4.4)
    axes = figure.subplots(2, len(shown), squeeze=False)
    for (scenery, one), column in zip(shown.items(), axes.T, strict=True):
        for axis, row, name in zip(column, (one.right, one.wrong), ("right", "wrong"), strict=True):
            axis.set_axis_off()
            if row is not None:
                axis.imshow(one.overlay(row), interpolation="nearest")
                axis.set_title(f"{scenery}, {name} {float(one.fits.peaks.correlation[row]):.2f}", fontsize=8)
    figures.save(figure, out)


if __name__ == "__main__":
    tyro.cli(main)
