"""HTML page of the loops within and between several recordings."""

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.levelling import upright_from_lidar
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures, loop_figures
from sglpr_jax.evaluation.overlay import overlaid
from sglpr_jax.evaluation.page.document import Section, document, figure_html, html_table, missing, paragraph
from sglpr_jax.evaluation.page.of_loops import SHOWN_PAIRS, about, loops_page, rejected_table, sections_of
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.frame_alignment import AlignedParts, Part
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.loops.search import FoundLoops
from sglpr_jax.pose_graph.folder import unique_names
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, placements
from sglpr_jax.se3 import inverse, yaw_of


def recordings_page(found: FoundLoops, *, optimized: OptimizedTrajectory | None = None) -> str:
    """Self-contained HTML of the page. With `optimized` trajectories, it says how far they moved."""
    if len(found.sessions) == 1:
        return loops_page(found, optimized=optimized)
    names = unique_names(found)
    sections = [Section("Transforms", _transforms(found, names))]
    if drawn := _together(found, names, optimized):
        sections.append(Section("Together", drawn))
    pairs = {pair: found.between(*pair) for pair in found.pairs}
    for (match, query), one in pairs.items():
        if one.transforms or one.rejected:
            title = f"{names[match]} and {names[query]}"
            sections.append(Section(title, f"{_pairs(one)}\n{rejected_table(one.rejected)}"))
    for number, name in enumerate(names):
        within = found.within(number)
        first, *others = (Section(f"{name}: {part.title}", part.body) for part in sections_of(within))
        sections += [Section(first.title, f"{paragraph(about(within))}\n{first.body}"), *others]
    between = sum(len(one.loops) for one in pairs.values())
    said = f"{len(found.loops) - between} loops within and {between} loops between {len(names)} recordings."
    return document(f"Loops of {', '.join(names)}", said, sections)


def _transforms(found: FoundLoops, names: list[str]) -> str:
    """Table of the transforms between the recordings."""
    header = ("match", "query", "loops", "x [m]", "y [m]", "z [m]", "yaw [deg]", "+- [m]", "+- [deg]")
    rows = []
    for match, query in found.pairs:
        pair, transforms = (names[match], names[query]), found.between(match, query).transforms
        rows += [
            (*map(_framed, pair, (aligned.match, aligned.query)), *_numbers(aligned)) for aligned in transforms
        ] or [(*pair, "no common place found", *[""] * 6)]
    meaning = (
        "Pose of the query recording's frame in the match recording's frame, with standard deviations of position in "
        "the plane and yaw. All numbers are in frames.json."
    )
    return f"{paragraph(meaning)}\n{html_table(header, rows, numbers=header[2:])}"


def _framed(name: str, part: Part) -> str:
    """Name of a recording, with the part if it has no odometry."""
    return name if part.is_odometry else f"{name}, from the LiDAR at scan {part.first} to scan {part.last}"


def _numbers(aligned: AlignedParts) -> tuple[str, ...]:
    pose, sigma = aligned.alignment.match_from_query, np.sqrt(np.diag(aligned.alignment.covariance))
    position = (f"{value:.2f}" for value in pose[:3, 3])
    yaw, spread = np.degrees(yaw_of(pose)), (np.hypot(*sigma[:2]), np.degrees(sigma[5]))
    return (f"{aligned.loops}", *position, f"{yaw:.2f}", *(f"{value:.2f}" for value in spread))


def _together(found: FoundLoops, names: list[str], optimized: OptimizedTrajectory | None) -> str:
    """Drawing of the trajectories of each group of recordings with a common place, if there is odometry."""
    placed = placements(found)
    if not figures.can_draw() or any(one.odometry is None for one in found.sessions):
        return ""
    parts = []
    for group in dict.fromkeys(group for group, _ in placed):
        poses = {
            number: to_group @ one.odometry[: one.frames]
            for number, ((other, to_group), one) in enumerate(zip(placed, found.sessions, strict=True))
            if other == group and one.odometry is not None
        }
        if len(poses) < 2:
            continue
        caption = f"The odometry in the frame of {names[group]}. A line connects the two scans of each loop."
        if optimized is not None:
            poses |= {number: found.split(optimized.poses)[number] for number in poses}
            caption = f"{str(optimized)[0].upper()}{str(optimized)[1:]}. Frame of {names[group]}."
        positions = {number: some[:, :3, 3] for number, some in poses.items()}
        pairs = [
            (positions[loop.query_session][loop.query], positions[loop.match_session][loop.match])
            for loop in found.loops
            if loop.match_session != loop.query_session and {loop.match_session, loop.query_session} <= set(positions)
        ]
        drawn = loop_figures.loops_between({names[number]: some for number, some in positions.items()}, pairs)
        parts.append(figure_html(drawn, "Trajectories in one frame", caption=caption))
    return "\n".join(parts)


def _pairs(found: FoundLoops) -> str:
    """Images of some loops between two recordings, laid over each other."""
    if not found.loops:
        return missing("No common place found.")
    if not figures.can_draw():
        return missing("The pictures need matplotlib: pip install 'sglpr-jax[viz]'.")
    rows = np.unique(np.linspace(0, len(found.loops) - 1, SHOWN_PAIRS).astype(int))
    pictures = {}
    for loop in (found.loops[row] for row in rows):
        ours, theirs = (found.sessions[number].recording for number in (loop.query_session, loop.match_session))
        title = f"query {ours.numbers[loop.query]}, match {theirs.numbers[loop.match]}"
        pictures[title] = _overlay(ours, theirs, loop)
    caption = "Match in red, query in cyan; cells with points of both are white. Pairs are spread over the recording."
    return figure_html(loop_figures.overlays(pictures), "Pairs of images", caption=caption)


def _overlay(ours: Recording, theirs: Recording, loop: Loop) -> Float[np.ndarray, "h w 3"]:
    query, match = (
        square_image(ours.record(loop.query, labels=False)),
        square_image(theirs.record(loop.match, labels=False)),
    )
    to_upright, from_upright = (
        upright_from_lidar(theirs.mounting_of(loop.match)),
        inverse(upright_from_lidar(ours.mounting_of(loop.query))),
    )
    upright = to_upright @ loop.match_from_query @ from_upright
    return overlaid(query, match, upright)
