"""HTML page of the loops of a recording: trajectory, matched images, probabilities, rejected pairs."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.levelling import mountings_of, upright_odometry, upright_poses
from sglpr_jax.evaluation import figures, loop_figures
from sglpr_jax.evaluation.overlay import overlaid
from sglpr_jax.evaluation.page.document import Section, document, figure_html, html_table, missing, paragraph
from sglpr_jax.loops.calibration import reliability_of
from sglpr_jax.loops.closure import MEANING, Loop, Rejected, counted
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.loops.search import FoundLoops, why_none
from sglpr_jax.pose_graph.optimize import OptimizedTrajectory, trajectory_error
from sglpr_jax.same_place import NEGATIVE_M

PAGE = "index.html"
SHOWN_PAIRS = 9
SHOWN_ROWS = 40


def loops_page(found: FoundLoops, *, optimized: OptimizedTrajectory | None = None) -> str:
    """Self-contained HTML of the page. With an `optimized` trajectory it shows the trajectory before and after."""
    return document(f"Loops of {found.recording.name}", about(found), sections_of(found, optimized=optimized))


def about(found: FoundLoops) -> str:
    """The number of loops and rejected pairs, and whether there is odometry, in one line."""
    return f"{found}; {'with odometry' if found.odometry is not None else 'without odometry'}."


def sections_of(found: FoundLoops, *, optimized: OptimizedTrajectory | None = None) -> list[Section]:
    """Sections of the page of a recording."""
    sections = [Section("Trajectory", _where(found))]
    if reasons := why_none(found):
        sections.insert(0, Section("Why no loops", "\n".join(map(paragraph, reasons))))
    if optimized is not None and found.frames:
        sections.append(Section("Corrected", _corrected(found, optimized)))
    return [
        *sections,
        Section("Pairs", _pairs(found)),
        Section("Loops", _table(found)),
        Section("Rejected", rejected_table(found.rejected)),
        Section("Reliability", _sure(found)),
    ]


def _where(found: FoundLoops) -> str:
    if not figures.can_draw():
        return missing("The drawing needs matplotlib: pip install 'sglpr-jax[viz]'.")
    if not found.frames:
        return missing("No scan was processed.")
    positions = found.recording.positions
    if found.odometry is not None:
        positions = upright_odometry(found.odometry, mountings_of(found.recording))[:, :3, 3]
    parts, wrong = [], _frames(wrong_loops(found))
    right = [pair for pair in _frames(found.loops) if pair not in set(wrong)]
    if positions is not None:
        what = "from the odometry" if found.odometry is not None else f"from {found.recording.pose_source}"
        lines = "Long lines are drift, or wrong loops."
        caption = f"The trajectory {what}. A line connects the two frames of each loop. {_judged(found) or lines}"
        drawn = loop_figures.loops(positions[: found.frames], right, wrong=wrong)
        parts.append(figure_html(drawn, "The loops on the trajectory", caption=caption))
    shown = [(one.query, one.match, one.probability) for one in found.loops]
    rejected = _frames(one.loop for one in found.rejected)
    order = loop_figures.loops_in_time(shown, found.frames, wrong=wrong, rejected=rejected)
    caption = "The match of each query. Rejected pairs are grey." if rejected else "The match of each query."
    parts.append(figure_html(order, "The loops in time", caption=caption))
    return "\n".join(parts)


def wrong_loops(found: FoundLoops) -> list[Loop]:
    """Return loops whose true positions are more than 20 m apart. Empty if true positions are not known."""
    return [loop for loop in found.loops if (_apart_m(found, loop) or 0) > NEGATIVE_M]


def _apart_m(found: FoundLoops, loop: Loop) -> float | None:
    """Return the true distance between the two frames of a loop in metres, or None if it is not known."""
    true = found.recording.positions
    return None if true is None else float(np.linalg.norm(true[loop.query] - true[loop.match]))


def _judged(found: FoundLoops) -> str:
    """Return a sentence with the number of wrong loops. Empty if true positions are not known."""
    if found.recording.positions is None or not found.loops:
        return ""
    wrong = len(wrong_loops(found))
    said = f"{wrong} of {len(found.loops)} loops are wrong{' (red)' if wrong else ''}"
    return f"{said}: more than {NEGATIVE_M:g} m apart by {found.recording.pose_source}."


def _frames(loops: Iterable[Loop]) -> list[tuple[int, int]]:
    return [(loop.query, loop.match) for loop in loops]


def _corrected(found: FoundLoops, optimized: OptimizedTrajectory) -> str:
    """Draw the trajectory before and after the correction. If true positions are known, the caption has both errors."""
    assert found.odometry is not None
    both = {"odometry": found.odometry[: found.frames], "optimized": optimized.poses}
    about = f"{str(optimized)[0].upper()}{str(optimized)[1:]}."
    true = found.recording.positions
    if true is not None and found.frames > 2:
        errors = (f"{name} {trajectory_error(poses, true[: found.frames]):.2f} m" for name, poses in both.items())
        about += f" Position error (RMSE after alignment with {found.recording.pose_source}): {', '.join(errors)}."
    if not figures.can_draw():
        return missing(about)
    level = {name: upright_odometry(poses, mountings_of(found.recording))[:, :3, 3] for name, poses in both.items()}
    return figure_html(loop_figures.trajectories(level), "The trajectory before and after", caption=about)


def _sure(found: FoundLoops) -> str:
    """Plot and table of the share of loops over the predicted probability, if true positions are known."""
    if found.recording.positions is None or found.model is None:
        return missing("The share of loops among the pairs is not known: the recording has no poses.")
    bins = reliability_of(found.candidates, found.model, found.recording.positions)
    if not bins:
        return missing("No pair was compared.")
    header = ("probability", "pairs", "loops", "share", "said")
    cells = ((f"{b.low:g} to {b.high:g}", b.pairs, b.loops, f"{b.share:.3f}", f"{b.said:.3f}") for b in bins)
    rows = [tuple(map(str, row)) for row in cells]
    caption = (
        f"Share of loops among all candidates, before neighbours and odometry are considered. A loop is a pair up to "
        f"10 m apart by {found.recording.pose_source}; pairs 10 to 20 m apart are ignored. Labels: number of pairs."
    )
    table = html_table(header, rows, numbers=header[1:])
    if not figures.can_draw():
        return table
    drawn = loop_figures.reliability([(one.said, one.share, one.pairs) for one in bins])
    return figure_html(drawn, "Share of loops over probability", caption=caption) + table


def _pairs(found: FoundLoops) -> str:
    if not found.loops:
        return missing("No loops.")
    if not figures.can_draw():
        return missing("The pictures need matplotlib: pip install 'sglpr-jax[viz]'.")
    rows = np.unique(np.linspace(0, len(found.loops) - 1, SHOWN_PAIRS).astype(int))
    pictures = {_title(found, found.loops[row]): overlay_of(found, found.loops[row]) for row in rows}
    caption = "Match in red, query in cyan; cells with points of both are white. Pairs are spread over the recording."
    return figure_html(loop_figures.overlays(pictures), "Pairs of images", caption=caption)


def overlay_of(found: FoundLoops, loop: Loop) -> Float[np.ndarray, "h w 3"]:
    """Overlay the images of the two scans of a loop, as RGB colours from 0 to 1 (`overlay.overlaid`)."""
    query, match = (square_image(found.recording.record(frame, labels=False)) for frame in (loop.query, loop.match))
    mounting = mountings_of(found.recording)
    return overlaid(query, match, upright_poses(loop.match_from_query, mounting, query=loop.query, match=loop.match))


def _title(found: FoundLoops, loop: Loop) -> str:
    numbers = found.recording.numbers
    return f"query {numbers[loop.query]}, match {numbers[loop.match]}"


def rejected_table(rejected: Sequence[Rejected]) -> str:
    """Table of the reasons for rejections, with counts."""
    if not rejected:
        return missing("No pair was rejected.")
    rows = [(reason, str(count), MEANING[reason]) for reason, count in counted(rejected).items()]
    about = "Pairs that look like loops but were rejected. They are listed in rejected.jsonl."
    return f"{paragraph(about)}\n{html_table(('reason', 'pairs', 'meaning'), rows, numbers=('pairs',))}"


def _table(found: FoundLoops) -> str:
    """Table of the wrong loops, if known, and of the loops with the lowest probabilities."""
    if not found.loops:
        return missing("No loops.")
    known = found.recording.positions is not None
    header = ("query", "match", "x [m]", "y [m]", "yaw [deg]", "probability", "overlap")
    header = (*header, "true distance [m]") if known else header
    wrong = set(_frames(wrong_loops(found)))
    first = sorted(found.loops, key=lambda loop: ((loop.query, loop.match) not in wrong, loop.probability))[:SHOWN_ROWS]
    ids = found.recording.ids
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
    return html_table(header, rows, numbers=header[2:])
