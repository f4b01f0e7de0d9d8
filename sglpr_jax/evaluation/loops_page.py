"""HTML page of the loops within and between recordings: trajectories, matched images, probabilities, rejected pairs."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.levelling import uprights
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.page import Picture, Section, Text, figure_picture, missing, render
from sglpr_jax.evaluation.report import TextTable
from sglpr_jax.loops.calibration import reliability_of
from sglpr_jax.loops.closure import MEANING, LoopClosure, RejectedClosure, counted, to_upright
from sglpr_jax.loops.frame_alignment import SegmentAlignment
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.loops.result import LoopSearchResult, diagnose_no_loops
from sglpr_jax.odometry.path import level_odometry
from sglpr_jax.pose_graph.folder import unique_names
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, placements, trajectory_error
from sglpr_jax.same_place import NEGATIVE_M
from sglpr_jax.se3 import yaw_of

PAGE = "index.html"
SHOWN_PAIRS = 9
SHOWN_ROWS = 40
NO_MATPLOTLIB = missing("The pictures need matplotlib: pip install 'sglpr-jax[viz]'.")


def loops_page(found: LoopSearchResult, *, optimized: OptimizedTrajectory | None = None) -> str:
    """Self-contained HTML of the page of one or several recordings.

    With `optimized` trajectories it shows them before and after the correction.
    """
    if len(found.sessions) == 1:
        return render(f"Loops of {found.sessions[0].recording.name}", _about(found), _of_recording(found, optimized))
    names = unique_names(found)
    sections = [_transforms(found, names), *_together(found, names, optimized)]
    pairs = {pair: found.between(*pair) for pair in found.pairs}
    for (match, query), one in pairs.items():
        if one.transforms or one.rejected:
            both = found.sessions[query].recording, found.sessions[match].recording
            blocks = [_pairs(*both, one.loops, nothing="No common place found."), *_reasons(one.rejected)]
            sections.append(Section(f"{names[match]} and {names[query]}", blocks))
    for number, name in enumerate(names):
        within = found.within(number)
        first, *others = _of_recording(within, None)
        sections.append(Section(f"{name}: {first.title}", [Text(_about(within)), *first.blocks]))
        sections += [Section(f"{name}: {part.title}", part.blocks) for part in others]
    between = sum(len(one.loops) for one in pairs.values())
    about = f"{len(found.loops) - between} loops within and {between} loops between {len(names)} recordings."
    return render(f"Loops of {', '.join(names)}", about, sections)


def _about(found: LoopSearchResult) -> str:
    return f"{found}; {'with odometry' if found.sessions[0].odometry is not None else 'without odometry'}."


def _of_recording(found: LoopSearchResult, optimized: OptimizedTrajectory | None) -> list[Section]:
    """Sections of a recording. With an `optimized` trajectory there is one about the correction."""
    session = found.sessions[0]
    reasons = diagnose_no_loops(found)
    why = [Section("Why no loops", [Text(reason) for reason in reasons])] if reasons else []
    corrected = [_corrected(found, optimized)] if optimized is not None and session.frames else []
    return [
        *why,
        Section("Trajectory", _trajectory(found)),
        *corrected,
        Section("Pairs", [_pairs(session.recording, session.recording, found.loops, nothing="No loops.")]),
        Section("Loops", [_table(found)]),
        Section("Rejected", _reasons(found.rejected)),
        Section("Reliability", _reliability(found)),
    ]


def _trajectory(found: LoopSearchResult) -> list[Picture | Text]:
    """Draw the loops on the trajectory, if positions are known, and the match of each query."""
    session = found.sessions[0]
    if not figures.can_draw():
        return [NO_MATPLOTLIB]
    if not session.frames:
        return [missing("No scan was processed.")]
    positions = session.recording.positions
    if session.odometry is not None:
        positions = level_odometry(session.odometry, uprights(session.recording))[:, :3, 3]
    drawn, wrong = [], _frames(wrong_loops(found))
    if positions is not None:
        what = "from the odometry" if session.odometry is not None else f"from {session.recording.pose_source}"
        judged = _judged(found) or "Long lines are drift, or wrong loops."
        caption = f"The trajectory {what}. A line connects the two frames of each loop. {judged}"
        right = [pair for pair in _frames(found.loops) if pair not in set(wrong)]
        plot = figures.loops(positions[: session.frames], right, wrong=wrong)
        drawn.append(figure_picture(plot, "The loops on the trajectory", caption=caption))
    shown = [(one.query, one.match, one.probability) for one in found.loops]
    rejected = _frames(one.loop for one in found.rejected)
    order = figures.loops_in_time(shown, session.frames, wrong=wrong, rejected=rejected)
    caption = "The match of each query. Rejected pairs are grey." if rejected else "The match of each query."
    return [*drawn, figure_picture(order, "The loops in time", caption=caption)]


def wrong_loops(found: LoopSearchResult) -> list[LoopClosure]:
    """Return loops whose true positions are more than 20 m apart. Empty if true positions are not known."""
    return [loop for loop in found.loops if (_apart_m(found, loop) or 0) > NEGATIVE_M]


def _apart_m(found: LoopSearchResult, loop: LoopClosure) -> float | None:
    """Return the true distance between the two frames of a loop in metres, or None if it is not known."""
    true = found.sessions[0].recording.positions
    return None if true is None else float(np.linalg.norm(true[loop.query] - true[loop.match]))


def _judged(found: LoopSearchResult) -> str:
    """Return a sentence with the number of wrong loops. Empty if true positions are not known."""
    session = found.sessions[0]
    if session.recording.positions is None or not found.loops:
        return ""
    wrong = len(wrong_loops(found))
    said = f"{wrong} of {len(found.loops)} loops are wrong{' (red)' if wrong else ''}"
    return f"{said}: more than {NEGATIVE_M:g} m apart by {session.recording.pose_source}."


def _frames(loops: Iterable[LoopClosure]) -> list[tuple[int, int]]:
    return [(loop.query, loop.match) for loop in loops]


def _corrected(found: LoopSearchResult, optimized: OptimizedTrajectory) -> Section:
    """Draw the trajectory before and after the correction. If true positions are known, the caption has both errors."""
    session = found.sessions[0]
    assert session.odometry is not None
    both = {"odometry": session.odometry[: session.frames], "optimized": optimized.poses}
    about = _sentence(optimized)
    true = session.recording.positions
    if true is not None and session.frames > 2:
        errors = (f"{name} {trajectory_error(poses, true[: session.frames]):.2f} m" for name, poses in both.items())
        about += f" Position error (RMSE after alignment with {session.recording.pose_source}): {', '.join(errors)}."
    if not figures.can_draw():
        return Section("Corrected", [missing(about)])
    upright = uprights(session.recording)[: session.frames]
    level = {name: level_odometry(poses, upright)[:, :3, 3] for name, poses in both.items()}
    drawn = figure_picture(figures.trajectories(level), "The trajectory before and after", caption=about)
    return Section("Corrected", [drawn])


def _sentence(said: object) -> str:
    return f"{str(said)[0].upper()}{str(said)[1:]}."


def _reliability(found: LoopSearchResult) -> list[Picture | Text | TextTable]:
    """Plot and table of the share of loops over the predicted probability, if true positions are known."""
    session = found.sessions[0]
    if session.recording.positions is None or found.model is None:
        return [missing("The share of loops among the pairs is not known: the recording has no poses.")]
    bins = reliability_of(session.candidates, found.model, session.recording.positions)
    if not bins:
        return [missing("No pair was compared.")]
    header = ("probability", "pairs", "loops", "share", "said")
    rows = [(f"{b.low:g} to {b.high:g}", f"{b.pairs}", f"{b.loops}", f"{b.share:.3f}", f"{b.said:.3f}") for b in bins]
    table = TextTable(header, rows, header[1:])
    if not figures.can_draw():
        return [table]
    caption = (
        f"Share of loops among all candidates, before neighbours and odometry are considered. A loop is a pair up to "
        f"10 m apart by {session.recording.pose_source}; pairs 10 to 20 m apart are ignored. Labels: number of pairs."
    )
    drawn = figures.reliability([(one.said, one.share, one.pairs) for one in bins])
    return [figure_picture(drawn, "Share of loops over probability", caption=caption), table]


def _pairs(query: Recording, match: Recording, loops: Sequence[LoopClosure], *, nothing: str) -> Picture | Text:
    """Images of some loops, laid over each other."""
    if not loops:
        return missing(nothing)
    if not figures.can_draw():
        return NO_MATPLOTLIB
    rows = np.unique(np.linspace(0, len(loops) - 1, SHOWN_PAIRS).astype(int))
    pictures = {
        f"query {query.numbers[loop.query]}, match {match.numbers[loop.match]}": overlay_of(query, match, loop)
        for loop in (loops[row] for row in rows)
    }
    caption = "Match in red, query in cyan; cells with points of both are white. Pairs are spread over the recording."
    return figure_picture(figures.overlays(pictures), "Pairs of images", caption=caption)


def overlay_of(query: Recording, match: Recording, loop: LoopClosure) -> Float[np.ndarray, "h w 3"]:
    """Overlay the images of the two scans of a loop, as RGB colours from 0 to 1 (`figures.overlaid`)."""
    images = (
        square_image(query.scan(loop.query, labels=False)),
        square_image(match.scan(loop.match, labels=False)),
    )
    level = to_upright(loop, query=query.mounting_of(loop.query), match=match.mounting_of(loop.match))
    return figures.overlaid(*images, level.match_from_query)


def _reasons(rejected: Sequence[RejectedClosure]) -> list[Text | TextTable]:
    """Table of the reasons for rejections, with counts."""
    if not rejected:
        return [missing("No pair was rejected.")]
    rows = [(reason, str(count), MEANING[reason]) for reason, count in counted(rejected).items()]
    about = "Pairs that look like loops but were rejected. They are listed in rejected.jsonl."
    return [Text(about), TextTable(("reason", "pairs", "meaning"), rows, ("pairs",))]


def _table(found: LoopSearchResult) -> Text | TextTable:
    """Table of the wrong loops, if known, and of the loops with the lowest probabilities."""
    session = found.sessions[0]
    if not found.loops:
        return missing("No loops.")
    known = session.recording.positions is not None
    header = ("query", "match", "x [m]", "y [m]", "yaw [deg]", "probability", "overlap")
    header = (*header, "true distance [m]") if known else header
    wrong = set(_frames(wrong_loops(found)))
    first = sorted(found.loops, key=lambda loop: ((loop.query, loop.match) not in wrong, loop.probability))[:SHOWN_ROWS]
    ids = session.recording.ids
    rows = [
        (
            ids[loop.query],
            ids[loop.match],
            f"{loop.match_from_query[0, 3]:.2f}",
            f"{loop.match_from_query[1, 3]:.2f}",
            f"{np.degrees(loop.yaw):.1f}",
            f"{loop.probability:.4f}",
            "" if loop.overlap is None else f"{loop.overlap:.2f}",
            *([f"{_apart_m(found, loop):.1f}"] if known else []),
        )
        for loop in first
    ]
    return TextTable(header, rows, header[2:])


def _transforms(found: LoopSearchResult, names: list[str]) -> Section:
    """Table of the transforms between the recordings."""
    header = ("match", "query", "loops", "x [m]", "y [m]", "z [m]", "yaw [deg]", "+- [m]", "+- [deg]")
    rows = []
    for match, query in found.pairs:
        pair, transforms = (names[match], names[query]), found.between(match, query).transforms
        for aligned in transforms:
            parts = zip(pair, (aligned.match, aligned.query), strict=True)
            framed = (
                name if part.is_odometry else f"{name}, from the LiDAR at scan {part.first} to scan {part.last}"
                for name, part in parts
            )
            rows.append((*framed, *_numbers(aligned)))
        rows += [] if transforms else [(*pair, "no common place found", *[""] * 6)]
    meaning = (
        "Pose of the query recording's frame in the match recording's frame, with standard deviations of position in "
        "the plane and yaw. All numbers are in frames.json."
    )
    return Section("Transforms", [Text(meaning), TextTable(header, rows, header[2:])])


def _numbers(aligned: SegmentAlignment) -> tuple[str, ...]:
    pose, sigma = aligned.match_from_query, np.sqrt(np.diag(aligned.covariance))
    position = (f"{value:.2f}" for value in pose[:3, 3])
    yaw, spread = np.degrees(yaw_of(pose)), (np.hypot(*sigma[:2]), np.degrees(sigma[5]))
    return (f"{aligned.loops}", *position, f"{yaw:.2f}", *(f"{value:.2f}" for value in spread))


def _together(found: LoopSearchResult, names: list[str], optimized: OptimizedTrajectory | None) -> list[Section]:
    """Section with the trajectories of each group of recordings with a common place, if there is odometry."""
    placed = placements(found)
    if not figures.can_draw() or any(one.odometry is None for one in found.sessions):
        return []
    drawn = []
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
            caption = f"{_sentence(optimized)} Frame of {names[group]}."
        positions: Mapping[int, np.ndarray] = {number: some[:, :3, 3] for number, some in poses.items()}
        pairs = [
            (positions[loop.query_session][loop.query], positions[loop.match_session][loop.match])
            for loop in found.loops
            if loop.match_session != loop.query_session and {loop.match_session, loop.query_session} <= set(positions)
        ]
        plot = figures.loops_between({names[number]: some for number, some in positions.items()}, pairs)
        drawn.append(figure_picture(plot, "Trajectories in one frame", caption=caption))
    return [Section("Together", drawn)] if drawn else []
