"""Evidence that is missing where places repeat: how well the right place of each revisit fits, and a lookalike."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Bool, Float, UInt8
from rich.console import Console
from rich.progress import track
from rich.table import Table

import sglpr_jax
from benchmarks.quality.repeating import RenderedDrive, chosen, compared, read
from benchmarks.quality.scoring import WAY_M, pose_errors
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.figures import overlaid
from sglpr_jax.loops.comparison import Fits
from sglpr_jax.registration.bev_alignment import refine
from sglpr_jax.registration.bev_spectra import within_reach
from sglpr_jax.registration.config import VerificationConfig
from sglpr_jax.se3 import transform, travelled

VERIFICATION = VerificationConfig()


class Revisit(NamedTuple):
    """A scan that was compared with its right place: the best fit at the true pose, and the best at a wrong one."""

    drive: RenderedDrive
    query: int
    fits: Fits
    right: int
    """Row of the fit."""
    wrong: int | None

    @property
    def ratio(self) -> float:
        """Correlation of the best wrong fit over that of the right one. 0 without a wrong fit."""
        if self.wrong is None:
            return 0.0
        return float(self.fits.peaks.correlation[self.wrong] / self.fits.peaks.correlation[self.right])

    @property
    def along_m(self) -> float:
        """Stated uncertainty of the right pose along its least certain direction, in metres."""
        images = self.image(self.query), self.image(int(self.fits.frames[self.right]))
        found = refine(*images, self.fits.peaks.at(self.right), config=VERIFICATION)
        return float(jax.device_get(found.along_m)) / self.drive.scale

    def image(self, frame: int) -> UInt8[np.ndarray, "m m"]:
        """Compared cells of a scan."""
        return np.asarray(within_reach(self.drive.seen[frame].image, VERIFICATION))

    def overlay(self, row: int) -> Float[np.ndarray, "n n 3"]:
        """The scan over the place of a fit, at the pose of this fit."""
        peak = self.fits.peaks.at(row)
        pose = transform(float(peak.x), float(peak.y), float(peak.yaw))
        return overlaid(self.image(self.query), self.image(int(self.fits.frames[row])), pose)


def evidence(
    drives: tyro.conf.Positional[Path],
    *,
    sceneries: tuple[str, ...] = (),
    sensor: str = "hdl64e",
    out: Path | None = None,
    weights: str = "sglpr",
) -> None:
    """Compare revisits of rendered drives with their right place and with the best lookalike.

    For each scenery the table has the revisits, the share of them that was compared with the right place, the share for
    which this place fits best, the best wrong fit over the right one (median), and the stated uncertainty of the
    position along the least certain direction. The picture shows a typical revisit of each scenery over its right place
    and over the best lookalike: cells of both are white, those of the query are cyan and those of the place red.

    Args:
        drives: folder of `repeating render`.
        sceneries: those to show; without them all.
        sensor: that of the drives.
        out: picture to write; its suffix is the format (extra viz).
        weights: the model that described the scans.
    """
    params, found, counts = sglpr_jax.load(weights), dict[str, list[Revisit]](), Counter[str]()
    for path in track(list(chosen(drives, sceneries, (sensor,))), description="compare"):
        drive = read(path)
        scenery, frames = drive.about["scenery"], compared(path, drive, params)
        count, some = _revisits(drive, frames)
        counts[scenery] += count
        found.setdefault(scenery, []).extend(some)
    table = Table("scenery", "revisits", "compared", "fits best", "lookalike", "along (m)")
    shown = {}
    for scenery, some in found.items():
        if not some:
            table.add_row(scenery, str(counts[scenery]), *[""] * 4)
            continue
        some.sort(key=lambda one: one.ratio)
        shown[scenery] = some[len(some) // 2]
        best = np.mean([one.ratio < 1 for one in some])
        along_m = np.median([one.along_m for one in some[:: len(some) // 20 + 1]])
        shares = (len(some) / counts[scenery], best, shown[scenery].ratio, along_m)
        table.add_row(scenery, str(counts[scenery]), *(f"{share:.2f}" for share in shares))
    Console().print(table)
    if out is not None:
        _draw(shown, out)


def _revisits(drive: RenderedDrive, frames: Sequence[Fits]) -> tuple[int, list[Revisit]]:
    """Number of revisits of a drive, and those that were compared with their right place."""
    poses, found = drive.world_from_lidar, []
    way_m = travelled(poses)
    queries = np.flatnonzero(drive.revisits).tolist()
    for query in queries:
        fits = frames[query]
        peaks = zip(fits.peaks.x, fits.peaks.y, fits.peaks.yaw, strict=True)
        each = np.array([transform(*map(float, peak)) for peak in peaks]).reshape(-1, 4, 4)
        errors = pose_errors([(query, frame) for frame in fits.frames.tolist()], each, poses)
        before = way_m[fits.frames] <= way_m[query] - WAY_M * drive.scale
        right = _best(fits, errors.right & before)
        if right is not None:
            found.append(Revisit(drive, query, fits, right, _best(fits, errors.wrong)))
    return len(queries), found


def _best(fits: Fits, allowed: Bool[np.ndarray, " k"]) -> int | None:
    """Row of the allowed fit with the highest correlation."""
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
