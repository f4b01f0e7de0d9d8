"""Draws the figures of evaluations and loop searches, without the global state of matplotlib."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, Num
from scipy.ndimage import affine_transform

from sglpr_jax.evaluation.protocols.result import Decision
from sglpr_jax.files import MOST_SHOWN, printable, replacing
from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.labels import taxonomy
from sglpr_jax.metrics import PrecisionRecallCurve
from sglpr_jax.se3 import inverse

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

DOTS_PER_INCH = 150
MOST_LEGEND_INSIDE = 4
"""Maximum number of entries of a legend inside the axes. A longer legend would cover the curves."""
LEGEND_CHARACTERS = 40
"""Maximum length of a name in a legend. Longer ones leave no room for the plot."""
LEGEND_INSIDE: Mapping[str, Any] = {"loc": "best", "framealpha": 0.95}
"""Options of a legend inside the axes."""
BLUE, RED = "#2b5fc4", "#d62728"

DECISIONS = {
    Decision.NOT_A_QUERY: ("not a query", "#d4d4d4", 4),
    Decision.TRUE_NEGATIVE: ("true negative", "#a9a9a9", 5),
    Decision.UNCOUNTED: ("not counted", "#8ab6e8", 5),
    Decision.TRUE_POSITIVE: ("true positive", BLUE, 12),
    Decision.FALSE_NEGATIVE: ("false negative", "#000000", 12),
    Decision.FALSE_POSITIVE: ("false positive", RED, 12),
}
"""Name, colour and size in square points of the dots of each decision, in drawing order: mistakes are on top. Red is
the colour of wrong matches in all figures. In figure 6 of the paper it is that of true positives."""


def save(figure: "matplotlib.figure.Figure", path: Path) -> None:
    """Write the figure atomically, in the format given by the suffix of `path`."""
    with replacing(path) as temporary:
        write(figure, temporary, format=path.suffix[1:])


def write(figure: "matplotlib.figure.Figure", file: Path | io.BytesIO, *, format: str = "png") -> None:
    """Write the figure to a file or a stream. Texts are drawn without formulas (`$`) and shortened if they are long."""
    from matplotlib.legend import Legend
    from matplotlib.text import Text

    in_legends = {text for legend in figure.findobj(Legend) for text in legend.findobj(Text)}
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        max_characters = LEGEND_CHARACTERS if text in in_legends else MOST_SHOWN
        text.set_parse_math(False)
        text.set_text("\n".join(printable(line, most=max_characters) for line in text.get_text().split("\n")))
    figure.savefig(file, format=format, dpi=DOTS_PER_INCH)


def precision_recall(curves: Mapping[str, PrecisionRecallCurve], *, title: str = "") -> "matplotlib.figure.Figure":
    """Draw precision over recall: one line for each named curve, with a dot at the highest F1 (figure 5)."""
    legend_beside = len(curves) > MOST_LEGEND_INSIDE
    figure = new_figure(8.0 if legend_beside else 5.2, 4.8)
    axes = figure.add_subplot(title=title, xlabel="recall", ylabel="precision", xlim=(0, 1.01), ylim=(0, 1.01))
    for f1 in (0.2, 0.4, 0.6, 0.8):  # thin contour lines of equal F1
        recall = np.linspace(f1 / (2 - f1), 1, 100)  # from the recall that has this F1 at precision 1
        axes.plot(recall, f1 * recall / (2 * recall - f1), color="0.85", linewidth=0.8, zorder=0)
        axes.text(f1, f1, f"F1 = {f1}", color="0.6", fontsize=7, ha="center", backgroundcolor="white", zorder=0)
    for name, curve in curves.items():
        (line,) = axes.plot(curve.recall, curve.precision, linewidth=1.8, label=f"{name} {curve.f1_max:.3f}")
        axes.plot(curve.recall[curve.best], curve.precision[curve.best], "o", color=line.get_color(), markersize=6)
    axes.set_aspect("equal")
    if legend_beside:
        figure.legend(title="dot: highest F1", loc="outside right upper", frameon=False)
    else:
        axes.legend(title="dot: highest F1", loc="lower left", framealpha=0.95)
    return figure


def trajectory(
    positions: Float[np.ndarray, "n 3"], decisions: Int[np.ndarray, " n"], *, title: str = ""
) -> "matplotlib.figure.Figure":
    """Draw the position of every frame from above, coloured by its `Decision`, as figure 6 does."""
    figure, (axes,) = axes_from_above(positions)
    axes.set_title(title)
    for decision, (name, colour, size) in DECISIONS.items():
        x, y = positions[decisions == decision, :2].T
        if len(x):
            axes.scatter(x, y, s=size, color=colour, linewidths=0, label=f"{name} ({len(x)})")
    dots, names = axes.get_legend_handles_labels()
    figure.legend(dots, names, loc="outside lower center", ncols=3, markerscale=2.5, frameon=False)
    return figure


def learning_curves(
    panels: Mapping[str, Mapping[str, Sequence[tuple[int, float]]]], *, xlabel: str = "step"
) -> "matplotlib.figure.Figure":
    """Draw curves of (step, value) points by name, in a panel for each title in `panels`."""
    figure = new_figure(6.4, 0.8 + 2.2 * len(panels))
    all_axes = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
    for axes, (title, curves) in zip(all_axes, panels.items(), strict=True):
        for name, points in curves.items():
            axes.plot(*np.array(points, dtype=np.float64).T, ".-", markersize=3, linewidth=1.4, label=name)
        axes.set_ylabel(title)
        axes.grid(color="0.92")
        if len(curves) > 1:
            axes.legend(**LEGEND_INSIDE)
    all_axes[-1].set_xlabel(xlabel)
    return figure


def segmentation_panel(
    bev: Num[np.ndarray, "h w"],
    truth: Int[np.ndarray, "h w"] | None,
    prediction: Int[np.ndarray, "h w"],
    *,
    resolution_m: float,
    categories: int = 20,
    title: str = "",
) -> "matplotlib.figure.Figure":
    """Draw point counts, true classes (if known) and predicted classes side by side (figure 7).

    The axes are in metres, with the sensor at the origin. The classes are those of `labels.taxonomy(categories)`.
    """
    from matplotlib.patches import Patch

    labels = taxonomy(categories)
    images = {"point counts": np.repeat(brightness(bev)[..., None], 3, axis=-1)}
    if truth is not None:
        images["true classes"] = labels.colors[truth]
    images["predicted classes"] = labels.colors[prediction]
    figure = new_figure(3.7 * len(images), 5.2)
    figure.suptitle(title)
    half_height_m, half_width_m = np.array(bev.shape) * resolution_m / 2
    extent = (-half_width_m, half_width_m, -half_height_m, half_height_m)
    for axes, (name, image) in zip(figure.subplots(1, len(images), sharey=True), images.items(), strict=True):
        axes.imshow(image, extent=extent, interpolation="nearest")
        axes.set(title=name, xlabel="x [m]")
    figure.axes[0].set_ylabel("y [m]")
    classes = np.unique(prediction) if truth is None else np.union1d(truth, prediction)
    patches = [Patch(facecolor=tuple(labels.colors[c] / 255), edgecolor="0.6", label=labels.names[c]) for c in classes]
    figure.legend(handles=patches, loc="outside lower center", ncols=min(len(patches), 8), frameon=False)
    return figure


def heat_maps(
    bev: Num[np.ndarray, "h w"], maps: Mapping[str, Float[np.ndarray, "h w"]], *, title: str = ""
) -> "matplotlib.figure.Figure":
    """Draw point counts and named maps of feature activations, each on its own scale (figure 8)."""
    figure = new_figure(2.1 * (1 + len(maps)), 2.6)
    figure.suptitle(title)
    panels = figure.subplots(1, 1 + len(maps), squeeze=False)[0]
    _show_image(panels[0], "point counts", brightness(bev), cmap="gray")
    for axes, (name, values) in zip(panels[1:], maps.items(), strict=True):
        _show_image(axes, name, values, cmap="inferno")
    return figure


def overlays(images: Mapping[str, Float[np.ndarray, "h w 3"]]) -> "matplotlib.figure.Figure":
    """Draw RGB images (0 to 1), three in a row. The keys are the titles."""
    rows = -(-len(images) // 3)
    figure = new_figure(9.0, 3.2 * rows)
    panels = figure.subplots(rows, 3, squeeze=False).ravel()
    for axes, (title, image) in zip(panels, images.items(), strict=False):
        _show_image(axes, title, image, interpolation="nearest")
    for axes in panels:  # also those of the last row without an image
        axes.set_axis_off()
    return figure


def _show_image(axes: "matplotlib.axes.Axes", title: str, image: Float[np.ndarray, "h w ..."], **options: str) -> None:
    """Draw an image with a small title and without axes. Options are those of `imshow`."""
    axes.imshow(image, **options)  # pyright: ignore[reportArgumentType]
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()


def loops(
    trajectories: Mapping[str, Float[np.ndarray, "n 3"]],
    pairs: Sequence[tuple[int, int]],
    *,
    wrong: Sequence[tuple[int, int]] = (),
) -> "matplotlib.figure.Figure":
    """Draw a drive from above, as each of the named trajectories side by side, with a line for each loop.

    `pairs` and `wrong` loops are (query, match). `wrong` loops are red and on top.
    """
    figure, panels = axes_from_above(np.concatenate(list(trajectories.values())), panels=len(trajectories))
    groups = [("loops", pairs, BLUE, 3)]
    if wrong:
        groups.append(("wrong", wrong, RED, 4))
    for axes, (title, positions) in zip(panels, trajectories.items(), strict=True):
        axes.set_title(title)
        axes.plot(*positions[:, :2].T, color="0.6", linewidth=1)
        for name, loop_frames, colour, layer in groups:
            for query, match in loop_frames:
                axes.plot(*positions[[query, match], :2].T, color=colour, linewidth=1, zorder=layer)
            queries = positions[[query for query, _ in loop_frames], :2]
            label = f"{name} ({len(loop_frames)})"
            axes.scatter(*queries.T, s=9, color=colour, linewidths=0, label=label, zorder=layer)
    panels[-1].legend(**LEGEND_INSIDE)
    return figure


def loops_between(
    positions_by_name: Mapping[str, Float[np.ndarray, "_ 3"]], pairs: Sequence[tuple[np.ndarray, np.ndarray]]
) -> "matplotlib.figure.Figure":
    """Draw the trajectories of several recordings from above. A line connects the two positions of each of `pairs`."""
    figure, (axes,) = axes_from_above(np.concatenate(list(positions_by_name.values())))
    for name, positions in positions_by_name.items():
        axes.plot(*positions[:, :2].T, linewidth=1.2, label=name)
    for query_and_match in pairs:
        axes.plot(*np.stack(query_and_match)[:, :2].T, color="0.4", linewidth=0.8, zorder=3)
    axes.legend(**LEGEND_INSIDE)
    return figure


def reliability(bins: Sequence[tuple[float, float, int]]) -> "matplotlib.figure.Figure":
    """Draw the true share of loops over the probability. Each bin is (mean probability, share, number of pairs)."""
    figure = new_figure(5.0, 4.6)
    axes = figure.add_subplot(xlabel="predicted probability", ylabel="share of loops", xlim=(-0.03, 1.09))
    axes.plot([0, 1], [0, 1], color="0.8", linewidth=1)  # perfect calibration
    probability, share, _ = np.array(bins).T
    axes.plot(probability, share, "o-", color=BLUE, markersize=5, linewidth=1.4)
    for x, y, pairs in bins:
        axes.annotate(f"{pairs}", (x, y), xytext=(5, -10), textcoords="offset points", fontsize=8, color="0.35")
    axes.set_ylim(-0.08, 1.05)
    axes.grid(color="0.92")
    return figure


def loops_in_time(
    loops: Sequence[tuple[int, int, float]],
    frames: int,
    *,
    wrong: Sequence[tuple[int, int]],
    rejected: Sequence[tuple[int, int]],
) -> "matplotlib.figure.Figure":
    """Plot the frame of each match over the frame of its query, coloured by the probability.

    `loops` are (query, match, probability), `wrong` and `rejected` (query, match). `frames` is the number of frames.
    Wrong loops are red crosses, rejected pairs are small grey dots behind the loops.
    """
    figure = new_figure(5.0, 4.2)
    axes = figure.add_subplot(xlabel="query (frame)", ylabel="match (frame)", xlim=(0, frames), ylim=(0, frames))
    axes.plot([0, frames], [0, frames], color="0.8", linewidth=1)
    if rejected:
        axes.scatter(*np.array(rejected).T, s=9, color="0.55", linewidths=0, label=f"rejected ({len(rejected)})")
    if loops:
        query, match, probability = np.array(loops).T
        dots = axes.scatter(query, match, s=8, c=probability, cmap="viridis", vmin=0.9, vmax=1, linewidths=0)
        figure.colorbar(dots, label="probability")
    if wrong:
        axes.scatter(*np.array(wrong).T, s=24, marker="x", color=RED, label=f"wrong ({len(wrong)})")
    if wrong or rejected:
        axes.legend(loc="upper left", framealpha=0.95)
    axes.grid(color="0.92")
    return figure


def overlaid(
    query: Num[np.ndarray, "n n"], match: Num[np.ndarray, "n n"], match_from_query: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "n n 3"]:
    """Overlay the density images of a query and its match, as RGB colours from 0 to 1.

    The match is green. The query, transformed to the frame of the match, is magenta. Cells occupied in both are white.
    """
    centre, pixels_per_m = (len(match) - 1) / 2, 1 / DENSITY_RESOLUTION_M
    # From (x, y, 1) in metres to (row, column, 1) in pixels. Rows run towards -y, columns towards x.
    pixel_from_metres = np.array([[0, -pixels_per_m, centre], [pixels_per_m, 0, centre], [0, 0, 1]])
    in_plane = inverse(match_from_query)[np.ix_([0, 1, 3], [0, 1, 3])]  # without z
    query_from_match = pixel_from_metres @ in_plane @ np.linalg.inv(pixel_from_metres)
    moved_query = affine_transform(np.asarray(query, np.float64), query_from_match, order=1, mode="grid-constant")
    green = np.sqrt(np.asarray(match, np.float64) / max(float(match.max()), 1e-9))
    magenta = np.sqrt(moved_query / max(float(moved_query.max()), 1e-9))
    return np.stack([magenta, green, magenta], axis=-1)


def brightness(bev: Num[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the logarithm of 1 + point counts as grey values from 0 to 1."""
    return np.log1p(bev) / max(np.log1p(bev).max(), 1e-9)


def new_figure(width: float, height: float) -> "matplotlib.figure.Figure":
    """Return an empty figure of this size in inches."""
    from matplotlib.figure import Figure  # slow import

    return Figure(figsize=(width, height), layout="constrained")


def axes_from_above(
    positions: Float[np.ndarray, "n 3"], *, panels: int = 1
) -> "tuple[matplotlib.figure.Figure, list[matplotlib.axes.Axes]]":
    """Return an empty figure for a drive seen from above, and its axes in metres. A flat drive gets a flat figure."""
    extent_x_m, extent_y_m = np.ptp(positions[:, :2], axis=0)
    width = 7.0 if panels == 1 else 5.0
    height = float(np.clip(1.8 + 0.8 * width * extent_y_m / max(extent_x_m, 1e-9), 3.0, 5.6))
    figure = new_figure(panels * width, height)
    all_axes = list(figure.subplots(1, panels, sharex=True, sharey=True, squeeze=False)[0])
    for axes in all_axes:
        axes.set(xlabel="x [m]")
        axes.set_aspect("equal", adjustable="datalim" if panels == 1 else "box")  # shared axes need a box
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
    all_axes[0].set_ylabel("y [m]")
    return figure, all_axes
