"""Real and simulated scans side by side: the same measures of both, as a table and as pictures."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import tyro

from benchmarks.quality.range_images import range_image_paths, read_range_image
from benchmarks.quality.scan_statistics import (
    HISTOGRAMS,
    NUMBERS,
    Measures,
    image_measures,
    scan_measures,
    total_variation,
)
from sglpr_jax.data.density_grid import MAX_COUNT
from sglpr_jax.data.density_image import density_image
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.figures import save
from sglpr_jax.labels import to_classes

PICTURES_PER_ROW = 8


@dataclasses.dataclass(frozen=True)
class Source:
    """The measures of some scans of one drive, and the density image of one of them."""

    name: str
    measures: Sequence[Measures]
    image: np.ndarray

    @property
    def is_real(self) -> bool:
        return self.name.startswith("real")

    def mean(self, measure: str) -> np.ndarray | None:
        """The mean over the scans, or None where this was not measured."""
        found = [measures[measure] for measures in self.measures if measure in measures]
        return np.mean(found, axis=0) if found else None


def main(
    *,
    out: Path,
    real: tuple[Path, ...] = (),
    real_range: Path | None = None,
    simulated: tuple[Path, ...] = (),
    scans: int = 30,
) -> None:
    """Measure real and simulated drives; write table.md, histograms.png and images.png.

    `images.png` shows real scans, which KITTI's licence keeps from being passed on; the other two are numbers only.

    Args:
        out: folder of the results.
        real: datasets of real scans, or of density images in BEVPlace's layout.
        real_range: folder of labelled range images, NN_FFFFFF.npz with `points` and `label` (learning classes).
        simulated: datasets that bin/simulate made.
        scans: the most scans of a drive that are measured, evenly spread over it.
    """
    sources = [source for root in real for source in measure_dataset("real", root, scans)]
    sources += measure_range_images(real_range) if real_range else []
    sources += [source for root in simulated for source in measure_dataset("simulated", root, scans)]
    if not sources:
        raise SystemExit("nothing to measure: name datasets with --real, --real-range or --simulated")
    out.mkdir(parents=True, exist_ok=True)
    (out / "table.md").write_text(f"{numbers_table(sources)}\n{distances_table(sources)}\n{histogram_table(sources)}")
    save(draw_histograms(sources), out / "histograms.png")
    save(draw_images(sources), out / "images.png")
    print(f"{numbers_table(sources)}\n{distances_table(sources)}\n{out}: table.md, histograms.png, images.png")


def measure_dataset(kind: str, root: Path, scans: int) -> Iterator[Source]:
    """Yield one source for each drive of a dataset."""
    for name in recording_names(root):
        drive = open_recording(root, name)
        chosen = np.unique(np.linspace(0, len(drive) - 1, min(scans, len(drive))).astype(int))
        what = "images" if drive.has_images else "scans"
        measures = [_measures(drive, i) for i in chosen]
        yield Source(f"{kind} {what} {name}", measures, _image(drive, chosen[len(chosen) // 2]))


def _measures(drive: Recording, i: int) -> Measures:
    if drive.has_images:
        return image_measures(_image(drive, i))
    labels = drive.labels(i)
    return scan_measures(drive.points(i), None if labels is None else to_classes(labels))


def _image(drive: Recording, i: int) -> np.ndarray:
    """The density image of one scan, in the orientation of eq. 1."""
    if drive.has_images:
        return np.rint(drive.image(i) * (255 / MAX_COUNT)).astype(np.uint8)
    return np.rot90(density_image(drive.points(i)), -1)


def measure_range_images(folder: Path) -> Iterator[Source]:
    """Yield one source for each drive of a folder of range images."""
    for name, of_drive in itertools.groupby(range_image_paths(folder), key=lambda path: path.stem[:2]):
        scans = [read_range_image(path) for path in of_drive]
        image = np.rot90(density_image(scans[0][0]), -1)
        yield Source(f"real range images {name}", [scan_measures(*scan) for scan in scans], image)


def numbers_table(sources: Sequence[Source]) -> str:
    """Mean over the scans, and the 10 % and 90 % quantiles."""
    rows = [["scans", *(str(len(source.measures)) for source in sources)]]
    for measure, title in NUMBERS.items():
        values = ([m[measure] for m in source.measures if measure in m] for source in sources)
        rows.append([title, *(_with_spread(found) if found else "" for found in values)])
    return _markdown(["", *(source.name for source in sources)], rows)


def distances_table(sources: Sequence[Source]) -> str:
    """How far each source's histograms lie from the mean of the real drives (of the others, for a real one)."""
    rows = [
        [title, *(_distance_from_real(source, measure, sources) for source in sources)]
        for measure, (title, _) in HISTOGRAMS.items()
    ]
    return _markdown(["total variation from the real drives, %", *(source.name for source in sources)], rows)


def _distance_from_real(source: Source, measure: str, sources: Sequence[Source]) -> str:
    own = source.mean(measure)
    others = [other.mean(measure) for other in sources if other.is_real and other is not source]
    known = [mean for mean in others if mean is not None]
    return f"{total_variation(own, np.mean(known, axis=0)):.0f}" if own is not None and known else ""


def histogram_table(sources: Sequence[Source]) -> str:
    """Every bin of every histogram, in percent."""
    tables = []
    for measure, (title, bins) in HISTOGRAMS.items():
        means = [source.mean(measure) for source in sources]
        rows = [
            [name, *("" if mean is None else f"{100 * mean[i]:.2f}" for mean in means)] for i, name in enumerate(bins)
        ]
        tables.append(_markdown([f"{title}, %", *(source.name for source in sources)], rows))
    return "\n".join(tables)


def _with_spread(values: Sequence[np.ndarray]) -> str:
    low, high = np.quantile(values, (0.1, 0.9))
    return f"{np.mean(values):.4g} ({low:.4g} to {high:.4g})" if high < 1e4 else f"{np.mean(values):,.0f}"


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def draw_histograms(sources: Sequence[Source]):
    """One panel for each histogram: real drives in grey, simulated ones in colours."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 12), layout="constrained")
    real = [source.name for source in sources if source.is_real]
    dashes = dict(zip(real, itertools.cycle(("-", "--", "-.", ":")), strict=False))
    styles = {s.name: {"color": "0.4", "linestyle": dashes[s.name]} if s.is_real else {"linewidth": 2} for s in sources}
    for axes, (measure, (title, bins)) in zip(figure.subplots(3, 3).flat, HISTOGRAMS.items(), strict=True):
        for source in sources:
            mean = source.mean(measure)
            values = np.full(len(bins), np.nan) if mean is None else 100 * mean
            axes.plot(values, marker="o", markersize=3, label=source.name, **styles[source.name])
        axes.set_title(f"{title}, %", fontsize=10)
        axes.set_xticks(range(len(bins)), bins, rotation=60, ha="right", fontsize=7)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def draw_images(sources: Sequence[Source]):
    """The density image of one scan of each drive: real ones above, simulated ones below."""
    from matplotlib.figure import Figure

    rows = [[s for s in sources if s.is_real][:PICTURES_PER_ROW], [s for s in sources if not s.is_real]]
    columns = max(len(row) for row in rows)
    figure = Figure(figsize=(3 * columns, 6.5), layout="constrained")
    for line, row in zip(figure.subplots(2, columns, squeeze=False), rows, strict=True):
        for axes in line:
            axes.axis("off")
        for axes, source in zip(line, row[:columns], strict=False):
            axes.imshow(source.image[13:138, 13:138], cmap="magma", vmin=0, vmax=255, interpolation="nearest")
            axes.set_title(source.name, fontsize=9)
    return figure


if __name__ == "__main__":
    tyro.cli(main)
