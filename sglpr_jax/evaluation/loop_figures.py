"""Figures of a loop search (extra `viz`): its loops, trajectories and probabilities."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Num
from scipy.ndimage import map_coordinates

from sglpr_jax.evaluation.figures import axes_from_above, new_figure
from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.se3 import inverse

if TYPE_CHECKING:
    import matplotlib.figure

LOOP_COLOUR, WRONG_COLOUR = "#2b5fc4", "#d62728"


def loops(
    positions: Float[np.ndarray, "n 3"], pairs: Sequence[tuple[int, int]], *, wrong: Sequence[tuple[int, int]] = ()
) -> "matplotlib.figure.Figure":
    """Draw a trajectory from above, with a line between the two frames of each loop.

    Arguments:
      positions: Position of each frame, in metres.
      pairs: Query and match of each loop, except those known to be wrong.
      wrong: Query and match of each loop known to be wrong, drawn in red.
    """
    figure, axes = axes_from_above(positions)
    axes.plot(*positions[:, :2].T, color="0.6", linewidth=1)
    for name, some, colour, layer in (("loops", pairs, LOOP_COLOUR, 3), ("wrong", wrong, WRONG_COLOUR, 4)):
        if name == "wrong" and not some:
            continue
        for query, match in some:
            axes.plot(*positions[[query, match], :2].T, color=colour, linewidth=1, zorder=layer)
        seen = positions[[query for query, _ in some], :2]
        axes.scatter(*seen.T, s=9, color=colour, linewidths=0, label=f"{name} ({len(some)})", zorder=layer)
    axes.legend(loc="best", framealpha=0.95)
    return figure


def trajectories(named: Mapping[str, Float[np.ndarray, "n 3"]]) -> "matplotlib.figure.Figure":
    """Draw named trajectories from above. The first trajectory is grey. A dot marks the end of each trajectory."""
    figure, axes = axes_from_above(np.concatenate(list(named.values())))
    for (name, positions), colour in zip(named.items(), ("0.6", "#2b5fc4", "#d62728"), strict=False):
        axes.plot(*positions[:, :2].T, color=colour, linewidth=1.2, label=name)
        axes.plot(*positions[-1, :2], "o", color=colour, markersize=4)
    axes.legend(loc="best", framealpha=0.95)
    return figure


def loops_between(
    named: Mapping[str, Float[np.ndarray, "_ 3"]], pairs: Sequence[tuple[np.ndarray, np.ndarray]]
) -> "matplotlib.figure.Figure":
    """Draw trajectories of several recordings in one frame from above, with a line between the scans of each loop.

    Arguments:
      named: Positions of each recording, in metres, by its name.
      pairs: Positions of query and match of each loop between two recordings, in metres.
    """
    figure, axes = axes_from_above(np.concatenate(list(named.values())))
    for name, positions in named.items():
        axes.plot(*positions[:, :2].T, linewidth=1.2, label=name)
    for ends in pairs:
        axes.plot(*np.array(ends)[:, :2].T, color="0.4", linewidth=0.8, zorder=3)
    axes.legend(loc="best", framealpha=0.95)
    return figure


def reliability(bins: Sequence[tuple[float, float, int]]) -> "matplotlib.figure.Figure":
    """Draw the share of loops over the predicted probability.

    Arguments:
      bins: Mean predicted probability, share of loops and number of pairs of each bin. The number labels its point.
    """
    figure = new_figure(5.0, 4.6)
    axes = figure.add_subplot(xlabel="predicted probability", ylabel="share of loops", xlim=(-0.03, 1.09))
    axes.plot([0, 1], [0, 1], color="0.8", linewidth=1)
    said, share, _ = np.array(bins).T
    axes.plot(said, share, "o-", color="#2b5fc4", markersize=5, linewidth=1.4)
    for x, y, pairs in bins:
        axes.annotate(f"{pairs}", (x, y), xytext=(5, -10), textcoords="offset points", fontsize=8, color="0.35")
    axes.set_ylim(-0.08, 1.05)
    axes.grid(color="0.92")
    return figure


def loops_in_time(
    found: Sequence[tuple[int, int, float]],
    frames: int,
    *,
    wrong: Sequence[tuple[int, int]] = (),
    rejected: Sequence[tuple[int, int]] = (),
) -> "matplotlib.figure.Figure":
    """Plot the frame number of each match over that of its query.

    Arguments:
      found: Query, match and probability of each loop. Less probable loops are lighter.
      frames: Number of frames.
      wrong: Query and match of each loop known to be wrong, drawn as red crosses.
      rejected: Query and match of each rejected pair, drawn as small grey dots behind the loops.
    """
    figure = new_figure(5.0, 4.2)
    axes = figure.add_subplot(xlabel="query (frame)", ylabel="match (frame)", xlim=(0, frames), ylim=(0, frames))
    axes.plot([0, frames], [0, frames], color="0.8", linewidth=1)
    if rejected:
        axes.scatter(*np.array(rejected).T, s=5, color="0.7", linewidths=0, label=f"rejected ({len(rejected)})")
    if found:
        query, match, probability = np.array(found).T
        dots = axes.scatter(query, match, s=8, c=probability, cmap="viridis", vmin=0.9, vmax=1, linewidths=0)
        figure.colorbar(dots, label="probability")
    if wrong:
        axes.scatter(*np.array(wrong).T, s=24, marker="x", color=WRONG_COLOUR, label=f"wrong ({len(wrong)})")
    if wrong or rejected:
        axes.legend(loc="upper left", framealpha=0.95)
    axes.grid(color="0.92")
    return figure


def overlays(pictures: Mapping[str, Float[np.ndarray, "h w 3"]]) -> "matplotlib.figure.Figure":
    """Draw coloured images with their titles, three in a row."""
    rows = -(-len(pictures) // 3)
    figure = new_figure(9.0, 3.2 * rows)
    panels = figure.subplots(rows, 3, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, (title, picture) in zip(panels, pictures.items(), strict=False):
        axes.imshow(picture, interpolation="nearest")
        axes.set_title(title, fontsize=9)
    return figure


def overlaid(
    query: Num[np.ndarray, "n n"],
    match: Num[np.ndarray, "n n"],
    match_from_query: Float[np.ndarray, "4 4"],
    *,
    resolution_m: float = DENSITY_RESOLUTION_M,
) -> Float[np.ndarray, "n n 3"]:
    """Overlay a query on its match, as RGB colours from 0 to 1.

    The match is red. The query, transformed to the frame of the match, is cyan. Cells occupied in both are white.
    """
    size = len(match)
    down, right = np.mgrid[:size, :size] - (size - 1) / 2
    query_from_match = inverse(match_from_query)
    x, y = right * resolution_m, -down * resolution_m
    at_x = query_from_match[0, 0] * x + query_from_match[0, 1] * y + query_from_match[0, 3]
    at_y = query_from_match[1, 0] * x + query_from_match[1, 1] * y + query_from_match[1, 3]
    cells = [-at_y / resolution_m + (size - 1) / 2, at_x / resolution_m + (size - 1) / 2]
    moved = map_coordinates(np.asarray(query, np.float64), cells, order=1, mode="grid-constant")
    return np.stack([_bright(match), _bright(moved), _bright(moved)], axis=-1)


def _bright(image: Num[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return np.sqrt(np.asarray(image, np.float64) / max(float(image.max()), 1e-9))
