"""bin/segment: write the semantic map of every scan or image of a sequence; score them where there are labels."""

import dataclasses
from pathlib import Path

import tyro

from sglpr_jax.cli.recording import RecordingOptions
from sglpr_jax.cli.runtime import console, parse_command, progress_bar, run
from sglpr_jax.fields import Share
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS

RESULT_FILE = "segmentation.json"


@dataclasses.dataclass(frozen=True)
class SegmentCommand:
    """Write each scan's semantic map as seen from above, one PNG of class ids (docs/reference/labels.md) per scan.

    Of a ready-made image it is a label image, pixel for pixel on the image, as bin/train --pseudo-labels reads it. With
    labels, also the intersection over union of every class and a picture of one scan (figure 7).

    Examples:
      bin/segment --data KITTI --seq 08 --out maps/
      bin/segment --weights runs/simulated --data IMAGES --seq 06 --min-confidence 0.8 --out pseudo/06
    """

    data: Path
    """A dataset, a bag or a folder of scans or ready-made images, of any layout that is known."""
    out: Path
    """The folder to write to; made if need be."""
    weights: str = DEFAULT_WEIGHTS
    """The name of shipped weights, a training run's folder, or one with config.json and model.safetensors."""
    source: tyro.conf.OmitArgPrefixes[RecordingOptions] = RecordingOptions()
    min_confidence: Share = 0.0
    """Leave cells unlabelled, and out of the score, whose likeliest class has a smaller probability."""


def segment_recording(command: SegmentCommand) -> Path:
    """Do what the command says; returns the folder written."""
    import numpy as np  # these bring JAX and more, which --help does not need

    from sglpr_jax.evaluation.segmentation import map_confusion
    from sglpr_jax.evaluation.semantic_score import draw_semantics, semantic_score
    from sglpr_jax.files import write_json
    from sglpr_jax.models.weights_file import load
    from sglpr_jax.retrieval.semantic_maps import save_map, semantic_maps

    recording, least = command.source.open(command.data), command.min_confidence
    params = load(command.weights)
    if not params.config.segments:
        raise ValueError(f"{command.weights}: expected weights with a segmentation head, found none in them")
    command.out.mkdir(parents=True, exist_ok=True)
    categories, classes, labelled, cells = params.config.categories, params.config.classes, 0, 0
    confusion = np.zeros((classes, classes), np.int64)
    with progress_bar(f"segment {recording.name}", len(recording)) as show:
        for row, record, found in semantic_maps(params, recording, min_confidence=least, on_progress=show):
            path = command.out / f"{recording.ids[row]}.png"
            save_map(path, found, record, categories=categories)
            confusion += map_confusion(found, categories=categories)
            labelled, cells = labelled + found.seen.sum(), cells + (found.counts > 0).sum()
    print(f"{command.out}: {len(recording)} semantic maps of {labelled / max(cells, 1):.0%} of the cells with points")
    if recording.has_labels:
        scores = semantic_score(confusion, recording, categories=categories)
        draw_semantics(params, recording, command.out, min_confidence=least)
        console().print(scores)
        write_json(command.out / RESULT_FILE, scores.to_json())
    return command.out


def main() -> None:
    """The entry point."""
    run(lambda: parse_command(SegmentCommand, "segment"), segment_recording)


if __name__ == "__main__":
    main()
