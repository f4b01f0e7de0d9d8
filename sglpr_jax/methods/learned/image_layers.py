"""Layers of the learned methods on images: convolution, normalisation, pooling and NetVLAD without biases."""

from typing import Any

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from sglpr_jax.models.convolution import convolve
from sglpr_jax.models.layers import l2_normalize, product

HE = nn.initializers.variance_scaling(2.0, "fan_out", "normal")
"""Initial values of the kernels, as in the residual networks of He et al. (2016)."""


class Convolution(nn.Module):
    """Square convolution whose derivative is computed by matrix products (`models.convolution`).

    Rows are padded by kernel // 2 zeros on each side. Columns are padded by as many zeros, or they wrap around.
    """

    features: int
    size: int = 3
    """Edge of the kernel, in pixels."""
    stride: int = 1
    """Stride along rows and columns."""
    circular: bool = False
    """Whether the columns wrap around."""
    use_bias: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b _ _ {self.features}"]:
        """Convolve images. An odd kernel gives ceil(size / stride) rows and columns."""
        kernel = self.param("kernel", HE, (self.size, self.size, x.shape[-1], self.features))
        y = convolve(x, kernel, (self.stride, self.stride), self.circular)
        if not self.use_bias:
            return y
        return y + self.param("bias", nn.initializers.zeros, (self.features,))[None, None, None]


def batch_norm(train: bool) -> nn.BatchNorm:
    """Return a batch normalisation with PyTorch's settings. In evaluation it uses the running statistics."""
    return nn.BatchNorm(use_running_average=not train, momentum=0.9, epsilon=1e-5)


def max_pool(x: Float[Array, "b h w c"], *, size: int, border: int = 0) -> Float[Array, "b _ _ c"]:
    """Return the maximum of each square of `size` pixels, with stride 2. `border` is the padding on each side."""
    padding: Any = ((border, border), (border, border))  # Flax declares the type of the names alone.
    return nn.max_pool(x, (size, size), (2, 2), padding)


class NetVLAD(nn.Module):
    """Soft assignment of local features to clusters, and sums of their residuals. There are no biases.

        a[n, k] = softmax over k of x[n] W[:, k]

        vlad[k, d] = sum over n of a[n, k] * (x[n, d] - centre[k, d]), L2-normalised over d, then as a whole

    The result is flattened cluster by cluster. Local features should have unit length.
    """

    clusters: int = 64

    @nn.compact
    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b {self.clusters}*d"]:
        """Pool the features of each image into one vector of unit length."""
        d = x.shape[-1]
        weights = self.param("assignment", nn.initializers.normal(1.0), (d, self.clusters))
        centres = self.param("centres", nn.initializers.normal(d**-0.5), (self.clusters, d))
        logits = product(x.reshape(-1, d), weights).reshape(*x.shape[:2], self.clusters)
        assigned = nn.softmax(logits)
        residuals = jnp.einsum("bnk,bnd->bkd", assigned, x) - assigned.sum(1)[..., None] * centres[None]
        return l2_normalize(l2_normalize(residuals).reshape(len(x), -1))
