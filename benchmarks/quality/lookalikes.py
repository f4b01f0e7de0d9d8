"""Comparison of the right place of each revisit with the best wrong place, in sceneries where places look alike."""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Bool, Float, UInt8

import sglpr_jax
from benchmarks.described import WAY_M, DescribedDrive, read_all, replay
from benchmarks.quality.scoring import pose_errors
from benchmarks.table import Table
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.figures import overlaid
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.comparison import Fits
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.registration.bev_alignment import refine
from sglpr_jax.registration.bev_config import VerificationConfig
from sglpr_jax.registration.bev_spectra import within_reach
from sglpr_jax.se3 import transform, travelled

VERIFICATION = VerificationConfig()


class Revisit(NamedTuple):
    """Scan that was compared with its right place. A fit is the alignment of the scan with one place."""

    drive: DescribedDrive
    query: int
    fits: Fits
    right: int  # row in `fits` of the best fit with the true pose
    wrong: int | None  # row of the best fit with a wrong pose, or None

    @property
    def ratio(self) -> float:
        """Correlation of the best wrong fit, divided by that of the right fit. 0 without a wrong fit."""
        if self.wrong is None:
            return 0.0
        return float(self.fits.peaks.correlation[self.wrong] / self.fits.peaks.correlation[self.right])

    @property
    def along_m(self) -> float:
        """Stated uncertainty of the right pose along its least certain direction, in metres."""
        images = self.image(self.query), self.image(int(self.fits.frames[self.right]))
        alignment = refine(*images, self.fits.peaks.at(self.right), config=VERIFICATION)
        return float(jax.device_get(alignment.along_m)) / self.drive.scale

    def image(self, frame: int) -> UInt8[np.ndarray, "m m"]:
        """Compared cells of a scan."""
        return np.asarray(within_reach(self.drive.keyframes[frame].image, VERIFICATION))

    def overlay(self, row: int) -> Float[np.ndarray, "n n 3"]:
        """Image of the scan over the place of the fit in this row, at the pose of the fit."""
        peak = self.fits.peaks.at(row)
        pose = transform(float(peak.x), float(peak.y), float(peak.yaw))
        return overlaid(self.image(self.query), self.image(int(self.fits.frames[row])), pose)


def evidence(
    drives: tyro.conf.Positional[Path],
    *,
    world: tuple[str, ...] = (),
    sensor: str = "hdl64e",
    out: Path | None = None,
    weights: str = "sglpr",
) -> None:
    """Compare revisits of described drives with their right place and with the best lookalike.

    For each world the table has the revisits, the share of them that was compared with the right place, the share for
    which this place fits best, the best wrong fit over the right one (median), and the stated uncertainty of the
    position along the least certain direction. The picture shows a typical revisit of each world over its right place
    and over the best lookalike: cells of both are white, those of the query are magenta and those of the place green.

    Args:
        drives: folder of `loops`.
        world: worlds to show; without them all.
        sensor: sensor of the drives.
        out: picture to write; its suffix is the format.
        weights: the model that described the scans.
    """
    params, of_worlds, counts = sglpr_jax.load(weights), dict[str, list[Revisit]](), Counter[str]()
    for drive in read_all(drives, world, (sensor,)):
        revisits = _compared_revisits(drive, params)
        counts[drive.facts["world"]] += int(drive.revisits.sum())
        of_worlds.setdefault(drive.facts["world"], []).extend(revisits)
    table, typical = Table("world", "revisits", "compared", "fits best", "lookalike", "along (m)"), dict[str, Revisit]()
    for name, revisits in of_worlds.items():
        if not revisits:
            table.add(name, counts[name], *[""] * 4)
            continue
        revisits.sort(key=lambda one: one.ratio)
        typical[name] = revisits[len(revisits) // 2]
        best = np.mean([one.ratio < 1 for one in revisits])
        along_m = np.median([one.along_m for one in revisits[:: len(revisits) // 20 + 1]])
        shares = (len(revisits) / counts[name], best, typical[name].ratio, along_m)
        table.add(name, counts[name], *(f"{share:.2f}" for share in shares))
    if out is not None:
        _draw(typical, out)


def _compared_revisits(drive: DescribedDrive, params: sglpr_jax.Params) -> list[Revisit]:
    """Revisits of a drive that were compared with their right place."""
    poses, revisits = drive.world_from_lidar, list[Revisit]()
    search = CandidateSearch(params, DetectorConfig(keyframe_m=0.0))  # each scan is a frame
    travelled_m, is_revisit = travelled(poses), drive.revisits
    for query, _ in enumerate(replay(search, drive)):
        fits = search.fits
        peaks = zip(fits.peaks.x, fits.peaks.y, fits.peaks.yaw, strict=True)
        fitted_poses = np.array([transform(*map(float, peak)) for peak in peaks]).reshape(-1, 4, 4)
        errors = pose_errors([(query, frame) for frame in fits.frames.tolist()], fitted_poses, poses)
        is_old = travelled_m[fits.frames] <= travelled_m[query] - WAY_M * drive.scale
        right = _best(fits, errors.right & is_old)
        if is_revisit[query] and right is not None:
            revisits.append(Revisit(drive, query, fits, right, _best(fits, errors.wrong)))
    return revisits


def _best(fits: Fits, allowed: Bool[np.ndarray, " k"]) -> int | None:
    """Row of the allowed fit with the highest correlation."""
    return int(np.argmax(np.where(allowed, fits.peaks.correlation, -1.0))) if allowed.any() else None


def _draw(typical: dict[str, Revisit], out: Path) -> None:
    """A column for each world: the right place above, the lookalike below."""
    figure = figures.new_figure(1.9 * len(typical), 4.4)
    axes = figure.subplots(2, len(typical), squeeze=False)
    for (world, revisit), column in zip(typical.items(), axes.T, strict=True):
        for axis, row, name in zip(column, (revisit.right, revisit.wrong), ("right", "wrong"), strict=True):
            axis.set_axis_off()
            if row is not None:
                axis.imshow(revisit.overlay(row), interpolation="nearest")
                axis.set_title(f"{world}, {name} {float(revisit.fits.peaks.correlation[row]):.2f}", fontsize=8)
    figures.save(figure, out)
