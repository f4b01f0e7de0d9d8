"""Errors of the poses of loops against their stated covariances, on simulated drives with true revisits.

If a covariance C is right, the normalised error squared e^T C^-1 e follows a chi-square: median 2.37 and 95 % quantile
7.81 for 3 degrees of freedom, 5.35 and 12.59 for 6. Aliases (`scoring.is_alias`) are excluded from the quantiles. The
constants of the library were fitted on seeds 200 to 207 and 500 to 507.
"""

import dataclasses
import sys
from collections.abc import Iterator

import jax
import numpy as np
import tyro
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist
from scipy.stats import chi2

import sglpr_jax
from benchmarks.drives import WALKS, Drive, Drives, drifted, in_memory
from benchmarks.quality.scoring import LOOP_M, closures_of, count_loops, is_alias, relative_errors, town_rule, twist
from benchmarks.table import Table
from sglpr_jax.data.choices import Gravity
from sglpr_jax.data.gravity import mounted
from sglpr_jax.data.mounting import upright_from_lidar
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import only
from sglpr_jax.loops.acceptance import register_loops
from sglpr_jax.loops.closure import LoopClosure, planar_loop, to_lidar
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.registration import bev_search
from sglpr_jax.registration.bev_alignment import refine
from sglpr_jax.registration.bev_spectra import match_spectra, query_spectra
from sglpr_jax.se3 import transform_covariance
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.styles import SCENERIES

APART_M, APART_S = 10.0, 30.0
"""Maximum distance in metres and minimum time in seconds between the scans of a pair."""
PLANAR, UNSEEN = np.array([0, 1, 5]), np.array([3, 4, 2])
"""Indices of x, y and yaw, and of roll, pitch and height, in an error of 6 degrees of freedom."""
TOWNS = ("town:00:300", "outskirts:00:301", "town:06:302", "outskirts:08:303", "town:08:304", "outskirts:06:305",
         "lanes:00:306", "gardens:06:307")  # fmt: skip
REPEATED = tuple(f"{name}:{revisit}:{400 + i}" for i, name in enumerate(REPEATING) for revisit in ("same", "opposite"))
PAIRS = Drives((*TOWNS, *REPEATED), sensor=("hdl64e", "hdl32e", "vlp16"), scans=600, azimuth_steps=None)
ERRORS = ("roll, pitch [deg]", "height [m]", "roll/pitch/height in 2 sigma", "95 % (7.81)")


def pairs(
    drives: tyro.conf.OmitArgPrefixes[Drives] = PAIRS,
    *,
    pairs: int = 80,
    gravity: Gravity | None = None,
    registered: bool = False,
) -> None:
    """Compare errors of pairs of revisits with their covariances. Prints a row for each world and sensor.

    The normalised error is that of x, y and yaw, or of 6 degrees of freedom if scans are registered. Further columns
    show roll, pitch and height: errors, the share within 2 standard deviations, and the normalised error. Drives in
    repeating sceneries have 300 scans.

    Args:
        drives: drives of the pairs.
        pairs: pairs of each drive.
        gravity: how gravity is found, as by `--gravity`. None: the true mounting.
        registered: register the scans in 6 degrees of freedom.
    """
    median, high = chi2.ppf([0.5, 0.95], 6 if registered else 3)
    columns = ("pairs", "aliases", f"median ({median:.2f})", f"95 % ({high:.2f})", "deviation, m", *ERRORS)
    table, groups = Table("world", "sensor", "carrier", *columns), dict[tuple[str, str, str], list[Drive]]()
    for drive in sorted(drives):
        groups.setdefault((drive.world, drive.sensor, drive.carrier), []).append(drive)
    for key, group in groups.items():
        scans = drives.scans if key[0] in SCENERIES else 300
        results = []
        for drive in group:
            recording = drives.simulate(drive, scans=scans)
            results.append(_errors(recording, drive.seed, pairs, gravity, registered=registered))
        errors, covariances, squares, aliases = (np.concatenate(arrays) for arrays in zip(*results, strict=True))
        deviations = np.sqrt(np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1])
        statistics = (np.median(squares), np.quantile(squares, 0.95), np.median(deviations)) if len(squares) else ()
        cells = [f"{statistic:.2f}" for statistic in statistics] or ["-"] * 3
        table.add(*key, len(aliases), aliases.sum(), *cells, *_cells(errors, covariances))


def _errors(
    drive: SimulatedRecording, seed: int, count: int, gravity: Gravity | None, *, registered: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Errors (k, 6), covariances (k, 6, 6) and normalised errors squared (k,) of the pairs that are no aliases.

    The last array (n,) says which of all pairs are aliases.
    """
    frames_of_pairs = _revisits(drive, count, np.random.default_rng(seed))
    frames = np.unique(frames_of_pairs)
    recording, poses = only(in_memory(drive, frames), frames.tolist()), drive.poses.world_from_lidar[frames]
    if gravity is not None:
        recording = mounted(dataclasses.replace(recording, mounting=None), "auto", gravity=gravity, known=False)
    loops = list(_aligned(recording, np.searchsorted(frames, frames_of_pairs)))
    if registered:
        loops = [_registered(recording, loop) for loop in loops]
    errors = relative_errors(loops, poses)
    aliases = np.array([is_alias(error) for error in errors], bool)
    true_peaks = [loop.covariance for loop, alias in zip(loops, aliases, strict=True) if not alias]
    covariances = np.array(true_peaks).reshape(-1, 6, 6)
    twists = np.array([twist(error) for error in errors[~aliases]]).reshape(-1, 6)
    if registered:
        return twists, covariances, _squares(twists, covariances, np.arange(6)), aliases
    level = transform_covariance(covariances, upright_from_lidar(recording.mounting))
    return twists, covariances, _squares(twists, level, PLANAR), aliases


def _squares(errors: np.ndarray, covariances: np.ndarray, axes: np.ndarray) -> Float[np.ndarray, " k"]:
    """Normalised errors squared of the degrees of freedom with the indices `axes`."""
    selected = errors[:, axes]
    return np.einsum("ni,nij,nj->n", selected, np.linalg.inv(covariances[:, axes[:, None], axes]), selected)


def _revisits(recording: SimulatedRecording, count: int, rng: np.random.Generator) -> Int[np.ndarray, "n 2"]:
    """Draws pairs of query and match. Half of the matches are the nearest scan, the others have random distances."""
    positions, times = recording.poses.world_from_lidar[:, :3, 3], recording.poses.times
    distance = cdist(positions, positions)
    distance[(distance > APART_M) | (times[:, None] - times[None] < APART_S)] = np.inf
    queries = np.sort(rng.permutation(np.flatnonzero(np.isfinite(distance).any(axis=1)))[:count])
    wanted_distance = np.where(rng.random(len(queries)) < 0.5, 0, rng.uniform(0, APART_M, len(queries)))
    matches = np.abs(distance[queries] - wanted_distance[:, None]).argmin(axis=1)
    return np.stack([queries, matches], axis=1)


def _aligned(recording: Recording, pairs: np.ndarray) -> Iterator[LoopClosure]:
    """Yields loops of pairs of query and match, whose poses come from the alignment of their images."""
    for query, match in pairs.tolist():
        query_image, match_image = (square_image(recording.scan(frame, labels=False)) for frame in (query, match))
        peak = bev_search.search(query_spectra(query_image), match_spectra(match_image[None])).at(0)
        alignment = jax.device_get(refine(query_image, match_image, peak))
        sensors = recording.mounting_of(query), recording.mounting_of(match)
        loop = planar_loop(query, match, alignment, probability=1.0, sensors=sensors)
        yield to_lidar(loop, query=sensors[0], match=sensors[1])


def _registered(recording: Recording, loop: LoopClosure) -> LoopClosure:
    """Loop with pose and covariance from registering the points of its scans, also if they overlap little."""
    accepted, rejected = register_loops(recording, recording, [loop], should_stop=lambda: False)
    return accepted[0] if accepted else rejected[0].loop


def search(drives: tyro.conf.OmitArgPrefixes[Drives] = WALKS, *, weights: str = "sglpr") -> None:
    """Search whole drives of a sensor that tilts, without and with odometry that drifts.

    Prints right loops (within 10 m), wrong ones (beyond 20 m), the share of revisits (within 5 m) that have a loop, and
    errors of roll, pitch and height of the right ones as `pairs` does.

    Args:
        drives: drives to search.
        weights: the model that describes the scans.
    """
    params = sglpr_jax.load(weights)
    table = Table("drive", "gravity", "odometry", "6 DoF", "right", "wrong", "recall", *ERRORS)
    for drive in drives:
        recording = drives.simulate(drive)
        poses, unknown = recording.poses.world_from_lidar, dataclasses.replace(in_memory(recording), mounting=None)
        rule = town_rule(poses[:, :3, 3], recording.poses.times)
        odometry = drifted(poses, seed=drive.seed)
        for gravity, given in (("recording", None), ("auto", None), ("auto", odometry)):
            opened = mounted(unknown, "auto", gravity=gravity, known=False)
            found = sglpr_jax.find_loops(opened, params, odometry=given, registered=False)
            session = found.sessions[0].recording
            print(*session.found, sep="\n", file=sys.stderr)
            registered = [_registered(session, loop) for loop in found.loops]
            for is_registered, loops in (("no", found.loops), ("yes", registered)):
                counts = count_loops(closures_of(loops), poses[:, :3, 3], rule)
                metres = [np.linalg.norm((poses[loop.query] - poses[loop.match])[:3, 3]) for loop in loops]
                right = [loop for loop, distance in zip(loops, metres, strict=True) if distance <= LOOP_M]
                errors = np.array([twist(error) for error in relative_errors(right, poses)]).reshape(-1, 6)
                covariances = np.array([loop.covariance for loop in right]).reshape(-1, 6, 6)
                has_odometry = "no" if given is None else "yes"
                cells = (gravity, has_odometry, is_registered, counts.right, counts.wrong, counts.recall)
                table.add(drive.name, *cells, *_cells(errors, covariances))


def _cells(errors: Float[np.ndarray, "k 6"], covariances: Float[np.ndarray, "k 6 6"]) -> list[str]:
    """Cells of `ERRORS`: errors of roll, pitch and height, their share within 2 sigma, and their normalised error."""
    if not len(errors):
        return ["-"] * len(ERRORS)
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    degrees, metres = np.degrees(np.abs(errors[:, UNSEEN[:2]])), np.abs(errors[:, UNSEEN[2]])
    within = (np.abs(errors) <= 2 * sigmas).mean(axis=0)[UNSEEN]
    return [
        f"{np.median(degrees):.2f}, 95 % {np.quantile(degrees, 0.95):.2f}",
        f"{np.median(metres):.3f}, 95 % {np.quantile(metres, 0.95):.3f}",
        "/".join(f"{share:.2f}" for share in within),
        f"{np.quantile(_squares(errors, covariances, UNSEEN), 0.95):.2f}",
    ]
