"""HTML page of the loops within and between several recordings."""

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.levelling import upright_from_lidar
from sglpr_jax.evaluation import figures, loop_figures
from sglpr_jax.evaluation.overlay import overlaid
from sglpr_jax.evaluation.page.document import Section, document, figure_html, html_table, missing, paragraph
from sglpr_jax.evaluation.page.of_loops import SHOWN_PAIRS, about, rejected_table, sections_of
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.loops.search_between import AlignedParts, FoundBetween, FoundRecordings, Part
from sglpr_jax.pose_graph.folder import unique_names
from sglpr_jax.pose_graph.optimize import OptimizedRecordings, placements
from sglpr_jax.se3 import inverse, yaw_of


def recordings_page(found: FoundRecordings, *, optimized: OptimizedRecordings | None = None) -> str:
    """Self-contained HTML of the page. With `optimized` trajectories, it says how far they moved."""
    names = unique_names(found)
    sections = [Section("Transforms", _transforms(found, names))]
    if drawn := _together(found, names, optimized):
        sections.append(Section("Together", drawn))
    for one in found.between:
        if one.aligned or one.rejected:
            title = f"{names[one.match]} and {names[one.query]}"
            sections.append(Section(title, f"{_pairs(found, one)}\n{rejected_table(one.rejected)}"))
    for name, within in zip(names, found.recordings, strict=True):
        first, *others = (Section(f"{name}: {part.title}", part.body) for part in sections_of(within))
        sections += [Section(first.title, f"{paragraph(about(within))}\n{first.body}"), *others]
    loops = sum(len(one.loops) for one in found.recordings), sum(len(one.loops) for one in found.between)
    said = f"{loops[0]} loops within and {loops[1]} loops between {len(names)} recordings."
    return document(f"Loops of {', '.join(names)}", said, sections)


def _transforms(found: FoundRecordings, names: list[str]) -> str:
    """Table of the transforms between the recordings."""
    header = ("match", "query", "loops", "x [m]", "y [m]", "z [m]", "yaw [deg]", "+- [m]", "+- [deg]")
    rows = []
    for one in found.between:
        pair = names[one.match], names[one.query]
        rows += [
            (*map(_framed, pair, (aligned.match, aligned.query)), *_numbers(aligned)) for aligned in one.aligned
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


def _together(found: FoundRecordings, names: list[str], optimized: OptimizedRecordings | None) -> str:
    """Drawing of the trajectories of each group of recordings with a common place, if there is odometry."""
    placed = placements(found)
    if not figures.can_draw() or any(one.odometry is None for one in found.recordings):
        return ""
    parts = []
    for group in dict.fromkeys(group for group, _ in placed):
        poses = {
            number: to_group @ one.odometry[: one.frames]
            for number, ((other, to_group), one) in enumerate(zip(placed, found.recordings, strict=True))
            if other == group and one.odometry is not None
        }
        if len(poses) < 2:
            continue
        caption = f"The odometry in the frame of {names[group]}. A line connects the two scans of each loop."
        if optimized is not None:
            poses |= {number: optimized.poses[number] for number in poses}
            said = optimized.corrections[[members[0] for members in optimized.groups].index(group)]
            caption = f"{str(said)[0].upper()}{str(said)[1:]}. Frame of {names[group]}."
        positions = {number: some[:, :3, 3] for number, some in poses.items()}
        pairs = [
            (positions[one.query][loop.query], positions[one.match][loop.match])
            for one in found.between
            if one.match in positions and one.query in positions
            for loop in one.loops
        ]
        drawn = loop_figures.loops_between({names[number]: some for number, some in positions.items()}, pairs)
        parts.append(figure_html(drawn, "Trajectories in one frame", caption=caption))
    return "\n".join(parts)


def _pairs(found: FoundRecordings, one: FoundBetween) -> str:
    """Images of some loops between two recordings, laid over each other."""
    if not one.loops:
        return missing("No common place found.")
    if not figures.can_draw():
        return missing("The pictures need matplotlib: pip install 'sglpr-jax[viz]'.")
    rows = np.unique(np.linspace(0, len(one.loops) - 1, SHOWN_PAIRS).astype(int))
    queries, matches = (found.recordings[number].recording.numbers for number in (one.query, one.match))
    pictures = {
        f"query {queries[loop.query]}, match {matches[loop.match]}": _overlay(found, one, loop)
        for loop in (one.loops[row] for row in rows)
    }
    caption = "Match in red, query in cyan; cells with points of both are white. Pairs are spread over the recording."
    return figure_html(loop_figures.overlays(pictures), "Pairs of images", caption=caption)


def _overlay(found: FoundRecordings, one: FoundBetween, loop: Loop) -> Float[np.ndarray, "h w 3"]:
    ours, theirs = (found.recordings[number].recording for number in (one.query, one.match))
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
