"""All methods: the network and the handcrafted methods."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from sglpr_jax.data.recording import Recording
from sglpr_jax.grid import Grid
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.describe import apply_network, stated_distance
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.weights_file import load_variables, method_of, variables_hash
from sglpr_jax.methods.method import HandcraftedMethod, ImageMethod, Method, RecordMethod, ScanMethod
from sglpr_jax.methods.names import NETWORK, SHIPPED, UNTRAINED
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.models.weights_file import load


def method_named(name: str, params: Params | None, recording: Recording) -> Method:
    """Return the network with these weights (None: `DEFAULT_WEIGHTS`), or a handcrafted method."""
    if name != NETWORK:
        return handcrafted(name, recording, model_preset("sglpr").grid)
    return network(load(DEFAULT_WEIGHTS) if params is None else params)


def methods_named(names: Sequence[str], params: Params | None, recording: Recording) -> dict[str, Method]:
    """Return the methods with these names. The network comes first if weights are given, or if nothing is given."""
    described_first = [NETWORK] if params is not None or not names else []
    return {name: method_named(name, params, recording) for name in dict.fromkeys([*described_first, *names])}


def method_beside(trained: Params, name: str, recording: Recording, *, seed: int = 0) -> Method:
    """Return a method for comparison with a newly trained network. On images it has the same window.

    Arguments:
      trained: Weights of the trained network.
      name: One of `BesideName`. `untrained` is the same network with random weights from `seed`, `shipped` has the
        `DEFAULT_WEIGHTS`.
      recording: Recording to describe.
      seed: Seed of the random weights.
    """
    if name == UNTRAINED:
        return network(init(jax.random.key(seed + 1), config=trained.config))
    if name == SHIPPED:
        return network(load(DEFAULT_WEIGHTS))
    return handcrafted(name, recording, trained.config.grid)


def method_with_weights(weights: str) -> Method:
    """Return the method of shipped weights, or of a folder of weights: of a run of bin/train or of bin/peers.

    Raises the errors of `load` or `load_variables`.
    """
    name = method_of(Path(weights))
    return trained_method(LEARNED[name], weights) if name in LEARNED else network(load(weights))


def trained_method(method: LearnedMethod, weights: str) -> RecordMethod:
    """Return a learned method with weights of `bin/peers train`.

    Arguments:
      method: Method, from `LEARNED`.
      weights: Folder of weights or of a run, or `random:SEED` for an untrained network.

    Raises the errors of `load_variables`.
    """
    variables = load_variables(weights, method)
    hashed = variables_hash(variables)
    return RecordMethod(
        prepare=method.prepare,
        describe=functools.partial(apply_network, variables, method=method),
        takes=method.takes,
        distance="l2" if method.compare is None else stated_distance(method.name, weights, hashed),
        about={"method": method.name, "weights": weights},
        weights_hash=hashed,
    )


def network(params: Params) -> ImageMethod:
    """Return the method that describes images with `params`."""
    config = params.config
    about = {"method": NETWORK, "model": dataclasses.asdict(config)}
    describe_views = functools.partial(describe, params)
    return ImageMethod(
        describe_views,
        config.grid,
        about,
        weights_hash(params),
        config.categories_read,
        config.image,
        field=field_of_view(config)[0],
    )


def handcrafted(name: str, recording: Recording, grid: Grid) -> Method:
    """Return a handcrafted method for the scans of `recording`. It takes points, whole images, or images of `grid`.

    Raises ValueError if the name is not in `HANDCRAFTED`.
    """
    if name not in HANDCRAFTED:
        raise ValueError(f"expected a handcrafted method, found {name!r}; available: {', '.join(HANDCRAFTED)}")
    method = HANDCRAFTED[name]
    return _on_images(method, recording, grid) if method.takes == "images" else _on_points(method)


def _on_images(method: HandcraftedMethod, recording: Recording, grid: Grid) -> ImageMethod:
    if recording.has_images:
        describe, window, about = method.describe_ready_made or method.describe, None, {}
    else:
        describe, window, about = method.describe, grid, {"grid": dataclasses.asdict(grid)}
    return ImageMethod(lambda images: describe(np.asarray(images)), window, {"method": method.name, **about})


def _on_points(method: HandcraftedMethod) -> ScanMethod:
    labels = method.takes == "labelled points"

    def describe_scan(points, classes):
        return method.describe(points, classes) if labels else method.describe(points)

    return ScanMethod(describe_scan, labels, method.distance_name, {"method": method.name})
