"""The PyTorch model of the benchmarks gives what ours gives: descriptors, class logits, losses and gradients."""

import dataclasses
import importlib

import jax
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.models.config import CircularConfig, HeadConfig, ModelConfig, SglprConfig, SwinConfig, model_preset
from sglpr_jax.models.sglpr import describe, segment
from sglpr_jax.training.config import TrainConfig

from .programs import printed, table

torch = pytest.importorskip("torch", reason="needs the extra torch")
pytestmark = pytest.mark.slow

POLAR = ModelConfig(
    grid=Grid(resolution_m=1.6, height=32, width=32),
    field="circle",
    blind_m=2.0,
    range_channel=True,
    polar=(16, 32),
    backbone=SwinConfig(patch=2, embed_dim=8, depths=(2, 2), heads=(1, 2), window=4, drop_path=0.0),
    head=HeadConfig(tap="tokens", channels=(8, 12), kernels=(3, 3), strides=(1, 2), clusters=4),
    detail=4,
)
STEM = CircularConfig(fine=(3,), widths=(4, 6), strides=(2, 1), means=(1, 2))
AROUND = HeadConfig(tap="tokens", channels=(8, 12), kernels=(3, 3), strides=(2, 1), means=(1, 2), clusters=4)
MODELS = {
    "square": model_preset("tiny"),
    "polar": POLAR,
    "circular": dataclasses.replace(
        POLAR,
        backbone=dataclasses.replace(STEM, fine=(3, 5)),
        head=HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=(), clusters=4),
    ),
    "sglpr": dataclasses.replace(
        POLAR, backbone=SglprConfig(stem=STEM, embed_dim=8, depths=(2, 2), heads=(1, 2)), head=AROUND
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_descriptors_and_logits_are_ours(name):
    inputs, reference = (importlib.import_module(module) for module in ("inputs", "torch_reference"))
    params = inputs.random_params(MODELS[name])
    images, _ = inputs.random_images(3, params.config.grid, image="points")
    with torch.inference_mode():
        descriptors, logits = reference.from_params(params).eval()(torch.tensor(images), segment=True)
    np.testing.assert_allclose(descriptors, describe(params, images), atol=1e-5)
    ours = jax.jit(segment)(params, images)
    np.testing.assert_allclose(logits, ours, atol=1e-5 * np.abs(ours).max())


def first_steps(config: ModelConfig, *, labels: bool) -> list[np.ndarray]:
    """Loss and gradient norm of two steps, ours and PyTorch's."""
    inputs, program = (importlib.import_module(module) for module in ("inputs", "train_step"))
    backbone = config.backbone
    if isinstance(backbone, SwinConfig):
        backbone = dataclasses.replace(backbone, drop_path=0.0)
    config = dataclasses.replace(config, backbone=backbone, categories=config.categories if labels else 0)
    training = TrainConfig(model=config, loss=program.PAPER_LOSS, rotate=False)
    params, batch = inputs.random_params(config), inputs.random_batch(training, 0, labels=labels)
    jobs = (
        program.jax_job(params, batch, training),
        program.torch_job(params, *program.seen_images(batch, training), training, False),
    )
    return [np.stack([job() for _ in range(program.CHECKED_STEPS)]) for job in jobs]


@pytest.mark.parametrize("labels", [True, False])
@pytest.mark.parametrize("name", MODELS)
def test_losses_and_gradients_are_ours(name, labels):
    ours, theirs = first_steps(MODELS[name], labels=labels)
    np.testing.assert_allclose(ours, theirs, rtol=1e-3)


def test_both_ways_of_reading_a_polar_image_agree(monkeypatch):
    """Sparse products, and the gathers that `torch.compile` is given."""
    image = importlib.import_module("benchmarks.torch_peer.torch_image")
    reading = image.from_polar(Grid(resolution_m=1.6, height=32, width=32), 16, 32)
    polar = torch.tensor(np.random.default_rng(0).standard_normal((2, 16, 32, 3), np.float32), requires_grad=True)

    def read() -> tuple[np.ndarray, np.ndarray]:
        polar.grad = None
        grid = reading(polar)
        grid.square().sum().backward()
        return grid.detach().numpy(), polar.grad.numpy()

    as_product = read()
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    for by_product, by_gathers in zip(as_product, read(), strict=True):
        np.testing.assert_allclose(by_product, by_gathers, atol=1e-5)


def test_descriptors_of_the_network_that_ships_are_timed():
    options = ("--preset", "circular", "--repeats", 2, "--calls", 2, "--threads", 1, "--chunk", 0, 1, "--batch", 2)
    rows = table(printed("torch_peer.describe", *options))
    assert [row[0] for row in rows] == ["JAX, chunk 0", "JAX, chunk 1"]
    assert all(float(row[3]) > 0 for row in rows)
