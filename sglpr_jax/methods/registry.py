"""Methods by name or by weights, as `retrieval.embed` runs them: networks, and handcrafted methods."""

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
from sglpr_jax.methods.learned.describe import apply_network, stated_distance
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.weights_file import load_variables, method_of, variables_hash
from sglpr_jax.methods.method import LABELLED, HandcraftedMethod, Method
from sglpr_jax.methods.names import NETWORK, SHIPPED, UNTRAINED
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.input_image import FEWEST_CELLS, field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.models.weights_file import load


def method_named(name: str, params: Params | None = None, *, ready_made: bool = False) -> Method:
    """Return the network with these weights (None: `DEFAULT_WEIGHTS`), or a handcrafted method.

    `ready_made` is for recordings of images (`Recording.has_images`), which a handcrafted method describes as a whole.
    """
    if name != NETWORK:
        return handcrafted(name, None if ready_made else model_preset("sglpr").grid)
    return network(load(DEFAULT_WEIGHTS) if params is None else params)


def method_beside(trained: Params, name: str, *, ready_made: bool, seed: int = 0) -> Method:
    """Return the method called `name`, one of `BesideName`, for comparison with a newly trained network.

    `untrained` is the same network with random weights from `seed`, `shipped` has the `DEFAULT_WEIGHTS`. A handcrafted
    method has the window of the network, or `ready_made` images as a whole.
    """
    if name == UNTRAINED:
        return network(init(jax.random.key(seed + 1), config=trained.config))
    if name == SHIPPED:
        return network(load(DEFAULT_WEIGHTS))
    return handcrafted(name, None if ready_made else trained.config.grid)


def method_with_weights(weights: str) -> Method:
    """Return the method of shipped weights, or of a folder of weights: of a run of bin/train or of bin/peers.

    Raises the errors of `load` or `load_variables`.
    """
    name = method_of(Path(weights))
    return trained_method(LEARNED[name], weights) if name in LEARNED else network(load(weights))


def trained_method(method: LearnedMethod, weights: str) -> Method:
    """Return a learned method with weights: a folder of weights or of a run, or `random:SEED`.

    Raises the errors of `load_variables`.
    """
    variables = load_variables(weights, method)
    sha256 = variables_hash(variables)
    return Method(
        {"method": method.name, "weights": weights},
        method.takes,
        lambda scan, angle: method.prepare(scan if angle is None else rotated_scan(scan, angle)),
        functools.partial(apply_network, variables, method=method),
        distance="l2" if method.compare is None else stated_distance(method.name, weights, sha256),
        weights_hash=sha256,
    )


def network(params: Params) -> Method:
    """Return the method that describes images with `params`."""
    config = params.config
    options = {"image": config.image, "categories": config.categories_read, "field": field_of_view(config)[0]}
    return Method(
        {"method": NETWORK, "model": dataclasses.asdict(config)},
        "labelled images" if config.categories_read else "images",
        functools.partial(checked_view, grid=config.grid, **options),
        lambda views: describe(params, *views),
        weights_hash=weights_hash(params),
    )


def handcrafted(name: str, grid: Grid | None) -> Method:
    """Return a handcrafted method. Its images are made from scans on `grid`, or are ready-made ones (None).

    Raises ValueError if the name is not in `HANDCRAFTED`.
    """
    if name not in HANDCRAFTED:
        raise ValueError(f"expected a handcrafted method, found {name!r}; available: {', '.join(HANDCRAFTED)}")
    method = HANDCRAFTED[name]
    if method.takes != "images":
        prepare = functools.partial(_describe_points, method)
        return Method({"method": name}, method.takes, prepare, lambda rows: rows, method.distance_name)
    describe_images = (grid is None and method.describe_ready_made) or method.describe
    return Method(
        {"method": name} | ({} if grid is None else {"grid": dataclasses.asdict(grid)}),
        method.takes,
        functools.partial(checked_view, grid=grid),
        lambda views: describe_images(views.image),
        method.distance_name,
    )


def _describe_points(method: HandcraftedMethod, scan: Scan, angle: float | None) -> np.ndarray:
    """Return the descriptor of the finite points of a scan, and of their classes if the method takes labels."""
    assert scan.points is not None
    finite = np.isfinite(scan.points).all(axis=1)
    points = scan.upright_points[finite]
    classes = [classes_of(scan, 20)[finite]] if method.takes in LABELLED else []
    return method.describe(points if angle is None else rotated(points, angle), *classes)


def checked_view(
    scan: Scan,
    angle: float | None,
    *,
    grid: Grid | None,
    image: ImageKind = "points",
    categories: int = 0,
    field: Bool[np.ndarray, "h w"] | None = None,
) -> View:
    """Return the `view` of a scan, rotated by `angle` in radians.

    Raises ValueError if too few cells within `field` (None: all) are occupied.
    """
    result = view(scan, grid, image=image, categories=categories, angle=None if angle is None else jnp.float32(angle))
    counts = np.asarray(result.image)
    occupied = np.count_nonzero(counts if field is None else counts * field)
    if occupied < FEWEST_CELLS:
        rows, columns = counts.shape
        raise ValueError(
            f"{scan.name}: expected points in at least {FEWEST_CELLS} cells of the window of {rows} x {columns} cells, "
            f"found points in {occupied}"
        )
    return result


def rotated_scan(scan: Scan, angle: float) -> Scan:
    """Return a scan whose points or image are rotated by an angle in radians, counter-clockwise."""
    if scan.points is not None:
        return dataclasses.replace(scan, points=rotated(scan.upright_points, angle), mounting=None)
    assert scan.image is not None
    return dataclasses.replace(scan, image=np.asarray(rotate_image(jnp.asarray(scan.image), jnp.float32(angle))))
