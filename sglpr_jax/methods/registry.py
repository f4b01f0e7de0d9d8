"""The `Method` of a name or of weights: networks and handcrafted methods, as `retrieval.embed` runs them."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from sglpr_jax.bev import rotate_image
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.views import View, classes_of, rotated, view
from sglpr_jax.grid import Grid, ImageKind
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.trained import apply_network, load_variables, method_of, name_of_distance, variables_hash
from sglpr_jax.methods.method import LABELLED, HandcraftedMethod, Method
from sglpr_jax.methods.names import NETWORK, SHIPPED, UNTRAINED
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.input_image import FEWEST_CELLS, field_of_view
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.models.weights import Params, own_hash, weights_hash
from sglpr_jax.models.weights_file import load


def method_named(name: str, params: Params | None = None, *, ready_made: bool = False) -> Method:
    """Return the network with the weights `params` (None: `DEFAULT_WEIGHTS`), or a handcrafted method.

    A handcrafted method makes images from scans on the grid of the preset `sglpr`. With `ready_made`, the recording has
    images (`Recording.has_images`), which the method does not crop.
    """
    if name != NETWORK:
        return handcrafted(name, None if ready_made else model_preset("sglpr").grid)
    return network(load(DEFAULT_WEIGHTS) if params is None else params)


def method_beside(trained: Params, name: str, *, ready_made: bool, seed: int) -> Method:
    """Return the method called `name`, one of `BesideName`, for comparison with a newly trained network.

    `untrained` is the same network with random weights from `seed`, `shipped` has the `DEFAULT_WEIGHTS`. A handcrafted
    method makes images on the grid of the trained network. It does not crop `ready_made` images.
    """
    if name == UNTRAINED:
        config = dataclasses.replace(trained.config, descriptors_of="")  # random weights have learned from no teacher
        return network(init(jax.random.key(seed + 1), config=config))
    if name == SHIPPED:
        return network(load(DEFAULT_WEIGHTS))
    return handcrafted(name, None if ready_made else trained.config.grid)


def method_with_weights(weights: str) -> Method:
    """Return the method of shipped weights, by name, or of a folder of bin/train or bin/peers. Raises as `load`."""
    name = method_of(Path(weights))
    return trained_method(LEARNED[name], weights) if name in LEARNED else network(load(weights))


def trained_method(method: LearnedMethod, weights: str) -> Method:
    """Return a learned method with the weights of a folder or of `random:SEED`. Raises as `load_variables`."""
    variables = load_variables(weights, method)
    sha256 = variables_hash(variables)
    return Method(
        about={"method": method.name, "weights": weights},
        takes=method.takes,
        prepare=functools.partial(_learned_input, method),
        describe=functools.partial(apply_network, variables, method=method),
        distance="l2" if method.compare is None else name_of_distance(method.name, weights, sha256),
        weights_hash=sha256,
    )


def _learned_input(method: LearnedMethod, scan: Scan, angle: float | None) -> np.ndarray:
    """Return the input of a scan rotated by `angle`. Raises ValueError if it is empty: all empty ones look alike."""
    inputs = method.prepare(scan if angle is None else rotated_scan(scan, angle))
    if not inputs.any():
        raise ValueError(f"{scan.name}: expected points or pixels that {method.name} reads, found none")
    return inputs


def network(params: Params) -> Method:
    """Return the method that describes images with `params`."""
    config = params.config
    model = dataclasses.asdict(config)
    learned = {"weights": own_hash(params)} if model.pop("descriptors_of") else {}  # `weights_hash` is the teacher's
    options = {"image": config.image, "categories": config.categories_read, "field": field_of_view(config)[0]}
    return Method(
        about={"method": NETWORK, "model": model} | learned,
        takes="labelled images" if config.categories_read else "images",
        prepare=functools.partial(checked_view, grid=config.grid, **options),
        describe=lambda views: describe(params, *views),
        weights_hash=weights_hash(params),
    )


def handcrafted(name: str, grid: Grid | None) -> Method:
    """Return a handcrafted method, for images on `grid` or ready-made ones (None). Raises ValueError if unknown."""
    if name not in HANDCRAFTED:
        raise ValueError(f"expected a handcrafted method, found {name!r}; available: {', '.join(HANDCRAFTED)}")
    method = HANDCRAFTED[name]
    if method.takes != "images":
        return Method(
            about={"method": name},
            takes=method.takes,
            prepare=functools.partial(_describe_points, method),
            describe=lambda descriptors: descriptors,  # `prepare` has described each scan
            distance=method.distance_name,
        )
    describe_images = (grid is None and method.describe_ready_made) or method.describe
    return Method(
        about={"method": name} | ({} if grid is None else {"grid": dataclasses.asdict(grid)}),
        takes=method.takes,
        prepare=functools.partial(checked_view, grid=grid),
        describe=lambda views: describe_images(views.image),
        distance=method.distance_name,
    )


def _describe_points(method: HandcraftedMethod, scan: Scan, angle: float | None) -> np.ndarray:
    """Return the descriptor of the finite points of a scan, rotated by `angle` in radians, with classes if needed."""
    assert scan.points is not None
    is_finite = np.isfinite(scan.points).all(axis=1)
    points = scan.upright_points[is_finite]
    if angle is not None:
        points = rotated(points, angle)
    if method.takes in LABELLED:
        return method.describe(points, classes_of(scan, 20)[is_finite])
    return method.describe(points)


def checked_view(
    scan: Scan,
    angle: float | None,
    *,
    grid: Grid | None,
    image: ImageKind = "points",
    categories: int = 0,
    field: Bool[np.ndarray, "h w"] | None = None,
) -> View:
    """Return the `view` of a scan: its image and class map, rotated by `angle` in radians.

    Raises ValueError if fewer than `FEWEST_CELLS` cells of the mask `field` (None: all cells) are occupied.
    """
    jax_angle = None if angle is None else jnp.float32(angle)
    checked = view(scan, grid, image=image, categories=categories, angle=jax_angle)
    counts = np.asarray(checked.image)
    occupied = np.count_nonzero(counts if field is None else counts * field)
    if occupied < FEWEST_CELLS:
        rows, columns = counts.shape
        expected = f"points in at least {FEWEST_CELLS} cells of the window of {rows} x {columns} cells"
        raise ValueError(f"{scan.name}: expected {expected}, found points in {occupied}")
    return checked


def rotated_scan(scan: Scan, angle: float) -> Scan:
    """Return a scan whose points or image are rotated counter-clockwise by an angle in radians."""
    if scan.points is not None:
        return dataclasses.replace(scan, points=rotated(scan.upright_points, angle), mounting=None)
    assert scan.image is not None
    return dataclasses.replace(scan, image=np.asarray(rotate_image(jnp.asarray(scan.image), jnp.float32(angle))))
