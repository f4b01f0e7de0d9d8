"""Export of `describe` with its weights as a program for runtimes without this package: StableHLO and ONNX."""

import dataclasses
import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Literal, get_args

import jax
import jax.export
import numpy as np

from sglpr_jax.data.density_image import CEILING_M, EDGE_STEP_M, FIRST_EDGE_M, FLOOR_M, MAX_VOXELS, REACH_M
from sglpr_jax.data.mounting import MODEL_HEIGHT_M
from sglpr_jax.extras import install_command, optional_module
from sglpr_jax.fields import check_value
from sglpr_jax.files import check_holds_only, json_text, replacing
from sglpr_jax.grid import DENSITY_MAX_COUNT, DENSITY_RESOLUTION_M, Grid
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.sglpr import describe
from sglpr_jax.models.weights import Params, for_places
from sglpr_jax.models.weights_file import CONFIG_FILE, load, save

ProgramFormat = Literal["stablehlo", "onnx"]
PLATFORMS = ("cpu", "cuda", "tpu")
INPUT_FILE = "input.json"
OPSET = 21


def save_program(params: Params, folder: Path | str, *, format: ProgramFormat) -> Path:
    """Export `describe` with its weights as a program from images (b, h, w) in float32 to descriptors (b, d).

    The folder gets `describe.stablehlo` or `describe.onnx`, the model's `config.json`, and `input.json`, which says how
    a scan becomes the program's input and holds the SHA-256 of the program.

    Arguments:
      params: Model that reads images only.
      folder: New folder, or one with an earlier program, which is replaced. It is written completely or not at all.
      format: `stablehlo` for `jax.export.deserialize` on CPU, CUDA and TPU (requires flatbuffers), or `onnx` (requires
        jax2onnx).

    Raises:
      ImportError: If a required package is missing. The message has the command that installs it.
      FileExistsError: If the folder holds other files.
      ValueError: If the format is unknown, or if the model reads labels.
      RuntimeError: If the conversion to ONNX fails.
    """
    check_value(format, ProgramFormat, "format")
    folder = Path(folder)
    if params.config.head.reads_labels:
        raise ValueError(f"expected a model that reads images only, found one that reads {params.config.head.input}")
    programs = [f"describe.{program_format}" for program_format in get_args(ProgramFormat)]
    check_holds_only(folder, (*programs, CONFIG_FILE, INPUT_FILE))
    params = for_places(params)
    program = stablehlo(params) if format == "stablehlo" else onnx(params)
    with replacing(folder) as new:
        new.mkdir()
        (new / f"describe.{format}").write_bytes(program)
        (new / CONFIG_FILE).write_text(json_text(dataclasses.asdict(params.config)))
        checksum = {"sha256": hashlib.sha256(program).hexdigest()}  # for users: runtimes do not check it
        (new / INPUT_FILE).write_text(json_text(input_description(params.config) | checksum))
    return folder


def stablehlo(params: Params) -> bytes:
    """Return `describe` with these weights, serialised by `jax.export`. Raises ImportError without flatbuffers."""
    optional_module("flatbuffers", "StableHLO", extra="export")
    grid = params.config.grid
    shape = jax.export.symbolic_shape(f"b, {grid.height}, {grid.width}")
    program = jax.jit(lambda bev: describe(params, bev))
    setting = "jax_traceback_in_locations_limit"
    previous_limit = getattr(jax.config, setting)
    jax.config.update(setting, 0)  # without source locations, the bytes are the same on every machine
    try:
        exported = jax.export.export(program, platforms=PLATFORMS)(jax.ShapeDtypeStruct(shape, np.float32))
        return bytes(exported.serialize())
    finally:
        jax.config.update(setting, previous_limit)


def onnx(params: Params) -> bytes:
    """Return `describe` with these weights as an ONNX model.

    A new process runs `convert` of this file, because jax2onnx changes JAX. Raises ImportError if a package is missing
    there, or RuntimeError if the conversion fails.
    """
    with tempfile.TemporaryDirectory() as temporary:
        weights, program = Path(temporary, "weights"), Path(temporary, "describe.onnx")
        save(params, weights)
        command = [sys.executable, "-m", "sglpr_jax.models.export", str(weights), str(program)]
        environment = os.environ | {"JAX_PLATFORMS": "cpu"}
        process = subprocess.run(command, capture_output=True, text=True, env=environment)
        if process.returncode:
            last_line = (process.stderr.strip().splitlines() or ["no message"])[-1]
            error = ImportError if "ModuleNotFoundError" in last_line else RuntimeError
            # without dependencies: those of jax2onnx include an Orbax that is too old for Flax and not needed
            packages = f"{install_command('export')} && {sys.executable} -m pip install --no-deps jax2onnx==0.17.1"
            raise error(f"the conversion to ONNX failed ({last_line}); it requires: {packages}")
        return program.read_bytes()


def input_description(config: ModelConfig) -> dict[str, str]:
    """Describe in words and formulas how a scan becomes the program's input, for users of other languages."""
    grid = config.grid
    return {
        "input": f"bev: float32 [b, {grid.height}, {grid.width}]",
        "output": f"descriptor: float32 [b, {config.head.descriptor_size}] of length 1; compared by Euclidean distance",
        "points": "finite ones, metres in the LiDAR frame: x forward, y left, z up, of an upright sensor "
        f"{MODEL_HEIGHT_M} m above the ground; of one that is h m above it, with the direction n of up in its frame "
        f"(length 1): R p + (0, 0, h - {MODEL_HEIGHT_M}), R being the smallest rotation that turns n to (0, 0, 1)",
        **(_point_count_texts(grid) if config.image == "points" else _density_texts(grid)),
    }


def _point_count_texts(grid: Grid) -> dict[str, str]:
    """Return the part of `input_description` for images of point counts, by keys of input.json."""
    r, u, v = grid.resolution_m, grid.width // 2, grid.height // 2 - 1
    return {
        "cells": f"{r} m wide; a point lies in bev[i, v, u] with u = floor(x / {r}) + {u}, v = {v} - floor(y / {r})",
        "values": "the number of points in each cell; points outside are left out",
    }


def _density_texts(grid: Grid) -> dict[str, str]:
    """Return the part for density images: the steps of `density_bev`, `even_cells` and `centre_crop` in words."""
    u, v = grid.width // 2, grid.height // 2  # column and row of the first cell right of, and below, the sensor
    return {
        "voxels": f"points with |x| < {REACH_M}, |y| < {REACH_M}, {FLOOR_M} < z < {CEILING_M} are sorted into voxels, "
        f"floor(point / edge); the edge is the smallest of {FIRST_EDGE_M}, {FIRST_EDGE_M + EDGE_STEP_M}, ... m that "
        f"leaves at most {MAX_VOXELS} voxels with points; each of these gives one centroid, the mean of its points",
        "counts": f"n = min(number of centroids, {DENSITY_MAX_COUNT}) for each pair "
        f"i = trunc(x / {DENSITY_RESOLUTION_M}), j = trunc(y / {DENSITY_RESOLUTION_M}); "
        f"value = round(255 n / N) {DENSITY_MAX_COUNT} / 255, N being the largest n",
        "cells": f"the value of (i, j) stands in bev[b, v, u] with u = {u} + i for i > 0, {u - 1} + i for i < 0, and "
        f"v = {v - 1} - j for j > 0, {v} - j for j < 0; for i = 0 half of it stands in u = {u - 1}, half in u = {u}, "
        f"for j = 0 half in v = {v - 1} and half in v = {v}; all other cells are 0, and what lies outside is left out",
    }


def convert(weights: Path, file: Path) -> None:
    """Write `describe` with the weights in folder `weights` as an ONNX file, with `input_description` as metadata."""
    from jax2onnx import to_onnx  # pyright: ignore[reportMissingImports]  (an optional package)

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
