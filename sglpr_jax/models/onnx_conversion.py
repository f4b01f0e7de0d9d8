"""Converts weights to an ONNX model: `python -m sglpr_jax.models.onnx_conversion WEIGHTS FILE`. See `program.onnx`."""

import sys
from pathlib import Path

from jax2onnx import to_onnx  # pyright: ignore[reportMissingImports]

from sglpr_jax.models.program import input_description
from sglpr_jax.models.sglpr import describe
from sglpr_jax.models.weights_file import load

OPSET = 21


def convert(weights: Path, file: Path) -> None:
    """Write `describe` as an ONNX model, with the description of its input in the metadata."""
    params = load(weights)
    grid = params.config.grid
    model = to_onnx(
        lambda bev: describe(params, bev),
        [("b", grid.height, grid.width)],
        opset=OPSET,
        input_names=["bev"],
        output_names=["descriptor"],
    )
    for key, value in input_description(params.config).items():
        model.metadata_props.add(key=key, value=value)
    file.write_bytes(model.SerializeToString())


if __name__ == "__main__":
    convert(Path(sys.argv[1]), Path(sys.argv[2]))
