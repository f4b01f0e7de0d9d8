"""Alignment of two images: the pose of `pose_search`, refined, with covariance and correlation.

Around the best peak of the exhaustive search, the correlation is computed on cells that are not merged. A Fourier
series interpolates between cells, and a parabola between rotations.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Num

from sglpr_jax.loops.compared_image import DEFAULT, prepared
from sglpr_jax.loops.config import VerificationConfig
from sglpr_jax.loops.peak_covariance import peak_covariance, ridge_covariance
from sglpr_jax.loops.pose_search import Peak, search
from sglpr_jax.loops.spectra import rotations, spectrum, twice


class Alignment(NamedTuple):
    """Pose of a query in the frame of a match, in the plane, with covariance and correlation."""

    x: Float[Array, "*b"]
    y: Float[Array, "*b"]
    """Position of the query's sensor in the match's frame, in metres."""
    yaw: Float[Array, "*b"]
    """Rotation of the query in the match's frame, in radians, counter-clockwise, from -pi to pi."""
    covariance: Float[Array, "*b 3 3"]
    """Covariance of x, y (metres) and yaw (radians), in the match's frame.

    It follows the shape of the peak: metres along a plain wall, centimetres across. It does not include the possibility
    that another peak is the correct one; see `second`.
    """
    correlation: Float[Array, "*b"]
    """Correlation at the peak: 1 for equal images, about 0 for unrelated ones."""
    second: Float[Array, "*b"]
    """Second-peak ratio: height of the second peak divided by the first. It is near 1 if another pose fits as well."""

    def one(self, k: int) -> "Alignment":
        """The k-th alignment."""
        return Alignment(*(value[k] for value in self))

    @property
    def along_m(self) -> float:
        """Standard deviation of the position of one alignment along its least certain direction, in metres."""
        return float(np.sqrt(np.linalg.eigvalsh(np.asarray(self.covariance)[:2, :2])[1]))


TURN_STEPS = 4
"""Number of rotation steps of the refinement to each side."""
RIDGE_TURNS = (0, 2, 6, 8)
"""Indices of these rotations at which a bent ridge is searched."""
SHIFT_STEPS = 5
"""Number of steps of half a cell of the refinement to each side, in x and y."""


@functools.partial(jax.jit, static_argnames="config")
def align(
    query: Num[Array | np.ndarray, "h w"],
    match: Num[Array | np.ndarray, "h w"],
    *,
    config: VerificationConfig = DEFAULT,
) -> Alignment:
    """Estimate the pose of a query in the frame of a match from their images.

    The function works under `jit` and `vmap`. For one query and several matches use `align_all`, which rotates the
    query only once.

    Arguments:
      query: Square image of counts in the orientation of eq. 1, with an even number of cells per side.
      match: Image of the same size.
      config: Settings of the comparison.

    Raises:
      ValueError: If the images are not square or have an odd number of cells.
    """
    peak = jax.tree.map(lambda values: values[0], search(query, jnp.asarray(match)[None], config=config))
    return refined(query, match, peak, config=config)


@functools.partial(jax.jit, static_argnames="config")
def refined(
    query: Num[Array | np.ndarray, "h w"],
    match: Num[Array | np.ndarray, "h w"],
    peak: Peak,
    *,
    config: VerificationConfig = DEFAULT,
) -> Alignment:
    """Refine a peak of `search` on cells that are not merged. Raises the errors of `search`."""
    second = jnp.where(peak.correlation > 1e-3, peak.second / jnp.maximum(peak.correlation, 1e-6), 1.0)
    query, match = prepared(query, config), prepared(match, config)
    pose, correlation, covariance = _refined(query, match, jnp.stack([peak.x, peak.y, peak.yaw]), config)
    yaw = jnp.mod(pose[2] + jnp.pi, 2 * jnp.pi) - jnp.pi
    return Alignment(pose[0], pose[1], yaw, covariance, correlation, second)


@functools.partial(jax.jit, static_argnames="config")
def align_all(
    query: Num[Array | np.ndarray, "h w"],
    matches: Num[Array | np.ndarray, "k h w"],
    *,
    config: VerificationConfig = DEFAULT,
) -> Alignment:
    """Align one query with each of k matches. Every field of the result has a leading axis of k."""
    matches = jnp.asarray(matches)
    peaks = search(query, matches, config=config)
    return jax.lax.map(lambda one: refined(query, *one, config=config), (matches, peaks))


def _refined(
    query: Float[Array, "m m"], match: Float[Array, "m m"], start: Float[Array, " 3"], config: VerificationConfig
) -> tuple[Float[Array, " 3"], Float[Array, ""], Float[Array, "3 3"]]:
    """Peak near the pose `start`: (x, y, yaw), its correlation, and the covariance of the pose."""
    cell_m, step_rad = config.resolution_m, np.float32(np.radians(config.refine_deg) / TURN_STEPS)
    yaws = start[2] + jnp.arange(-TURN_STEPS, TURN_STEPS + 1) * step_rad
    product = spectrum(match[None], cell_m, config) * jnp.conj(spectrum(rotations(query, yaws), cell_m, config))
    size = product.shape[1]
    steps = np.arange(-SHIFT_STEPS, SHIFT_STEPS + 1, dtype=np.float32) * (cell_m / 2)
    xs, ys = start[0] + steps, start[1] + steps
    rows = _waves(-ys / cell_m, np.fft.fftfreq(size))
    columns = _waves(xs / cell_m, np.fft.rfftfreq(size)) * twice(size)
    volume = jnp.einsum("tij,yi,xj->xyt", product, rows, columns).real / size**2
    peak = jnp.unravel_index(jnp.argmax(volume), volume.shape)
    middle = [jnp.clip(at, 1, n - 2) for at, n in zip(peak, volume.shape, strict=True)]
    value, gradient, hessian = _parabola(jax.lax.dynamic_slice(volume, [at - 1 for at in middle], (3, 3, 3)))
    offset = jnp.clip(jnp.linalg.solve(hessian - 1e-6 * jnp.eye(3), -gradient), -1, 1)
    sizes = jnp.array([cell_m / 2, cell_m / 2, step_rad])
    pose = jnp.stack([xs[middle[0]], ys[middle[1]], yaws[middle[2]]]) + offset * sizes
    correlation = value + gradient @ offset + offset @ hessian @ offset / 2
    curvature = -hessian / (sizes[:, None] * sizes[None])
    turns = jnp.concatenate([middle[2][None] + jnp.round(offset[2]).astype(int), np.array(RIDGE_TURNS)])
    ridge = ridge_covariance(
        product[turns],
        pose,
        yaws[turns],
        curvature,
        cell_m=cell_m,
        reach_m=config.reach_m,
        max_shift_m=config.max_shift_m,
    )
    covariance = peak_covariance(
        curvature,
        correlation,
        occupied=jnp.minimum((query > 0).sum(), (match > 0).sum()),
        apart_m=jnp.hypot(pose[0], pose[1]),
        ridge=ridge,
    )
    return pose, correlation, covariance


def _waves(shifts: Float[Array, " k"], frequencies: Float[np.ndarray, " f"]) -> Complex[Array, "k f"]:
    """Factors of a Fourier series at shifts between cells."""
    return jnp.exp(2j * np.pi * shifts[:, None] * jnp.asarray(frequencies, jnp.float32)[None])


def _parabola(block: Float[Array, "3 3 3"]) -> tuple[Float[Array, ""], Float[Array, " 3"], Float[Array, "3 3"]]:
    """Value, gradient and Hessian at the centre of the least-squares parabola through 27 values."""
    offsets = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    columns = [np.ones(27), *offsets.T, *(offsets[:, i] * offsets[:, j] for i, j in pairs)]
    fitted = jnp.asarray(np.linalg.pinv(np.stack(columns, 1)), jnp.float32) @ block.reshape(27)
    half = jnp.zeros((3, 3)).at[tuple(np.array(pairs).T)].set(fitted[4:])
    return fitted[0], fitted[1:4], half + half.T
