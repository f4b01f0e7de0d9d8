"""Rigid transforms as 4 x 4 matrices, which compose as `a_from_b @ b_from_c == a_from_c`, and planar poses."""

import numpy as np
from jaxtyping import Bool, Float

PlanarPose = Float[np.ndarray, "... 3"]
"""Poses in the x-y plane: x and y in metres, yaw in radians counter-clockwise."""
ROTATION_TOLERANCE = 0.01
"""Maximum deviation of an entry of R R^T from the identity, for rotations R in files with few digits, and of the length
of a quaternion from 1."""


def transform(x: float, y: float, yaw: float) -> Float[np.ndarray, "4 4"]:
    """Transform in the x-y plane, from x and y in metres and yaw in radians counter-clockwise."""
    a_from_b = np.eye(4)
    a_from_b[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    a_from_b[:2, 3] = x, y
    return a_from_b


def inverse(a_from_b: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
    """Return the inverses b_from_a of rigid transforms."""
    rotation = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    b_from_a = np.zeros_like(a_from_b)
    b_from_a[..., :3, :3] = rotation
    b_from_a[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, a_from_b[..., :3, 3])
    b_from_a[..., 3, 3] = 1
    return b_from_a


def yaw_of(a_from_b: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n"]:
    """Yaw of the x axis of frame b in frame a, in radians."""
    return np.asarray(np.arctan2(a_from_b[..., 1, 0], a_from_b[..., 0, 0]))


def planar_pose(a_from_b: Float[np.ndarray, "*n 4 4"]) -> PlanarPose:
    """Project poses to the x-y plane of frame a."""
    return np.concatenate([a_from_b[..., :2, 3], yaw_of(a_from_b)[..., None]], axis=-1)


def compose_planar(a_from_b: PlanarPose, b_from_c: PlanarPose) -> PlanarPose:
    """Compose planar poses to a_from_c."""
    a_from_b, b_from_c = np.broadcast_arrays(a_from_b, b_from_c)
    x, y, yaw = np.moveaxis(b_from_c, -1, 0)
    cos, sin = np.cos(a_from_b[..., 2]), np.sin(a_from_b[..., 2])
    x_in_a = a_from_b[..., 0] + cos * x - sin * y
    y_in_a = a_from_b[..., 1] + sin * x + cos * y
    return np.stack([x_in_a, y_in_a, wrap_angle(a_from_b[..., 2] + yaw)], axis=-1)


def inverse_planar(a_from_b: PlanarPose) -> PlanarPose:
    """Return the inverse planar poses b_from_a."""
    x, y, yaw = np.moveaxis(a_from_b, -1, 0)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([-cos * x - sin * y, sin * x - cos * y, -yaw], axis=-1)


def wrap_angle(angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Wrap angles in radians to the range from -pi to pi."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def transformed(a_from_b: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Transform points from frame b to frame a."""
    return points @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def adjoint(a_from_b: Float[np.ndarray, "*m 4 4"]) -> Float[np.ndarray, "*m 6 6"]:
    """Matrix that transforms a small motion of a rigid body (metres, then radians) from its frame b to its frame a."""
    x, y, z = np.moveaxis(a_from_b[..., :3, 3], -1, 0)
    rotation = a_from_b[..., :3, :3]
    cross = np.zeros(rotation.shape)  # cross @ v is the cross product of the translation and v
    cross[..., 0, 1], cross[..., 0, 2] = -z, y
    cross[..., 1, 0], cross[..., 1, 2] = z, -x
    cross[..., 2, 0], cross[..., 2, 1] = -y, x
    matrix = np.zeros((*rotation.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = rotation
    matrix[..., :3, 3:] = cross @ rotation
    return matrix


def transform_covariance(covariance: Float[np.ndarray, "*n 6 6"], a_from_b: Float[np.ndarray, "*m 4 4"]) -> np.ndarray:
    """Transform the covariance of a small motion of a rigid body (metres, then radians) from frame b to frame a."""
    matrix = adjoint(a_from_b)
    return matrix @ covariance @ np.swapaxes(matrix, -1, -2)


def quaternions(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4"]:
    """Return the rotations of poses as quaternions x, y, z, w with non-negative w."""
    from scipy.spatial.transform import Rotation  # imported here because the import is slow

    return Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)


def poses_of(
    positions: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "n 3 3"] | None = None
) -> Float[np.ndarray, "n 4 4"]:
    """Combine positions and rotations to poses. By default the rotations are the identity."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    if rotations is not None:
        poses[:, :3, :3] = rotations
    return poses


def from_quaternions(
    translations: Float[np.ndarray, "n 3"], quaternions: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n 4 4"]:
    """Return the poses with these translations and with rotations from quaternions (x, y, z, w)."""
    from scipy.spatial.transform import Rotation  # imported here because the import is slow

    return poses_of(translations, Rotation.from_quat(quaternions).as_matrix().reshape(-1, 3, 3))


def lengths_along(line: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Length of a polyline from its first point to each point."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def travelled(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n"]:
    """Travelled distance from the first pose to each pose, in metres."""
    return lengths_along(poses[:, :3, 3])


def are_rotations(matrices: Float[np.ndarray, "*b 3 3"]) -> Bool[np.ndarray, "*b"]:
    """Whether each matrix R is a rotation: all entries of R R^T - I are below 0.01, and R is not a reflection."""
    with np.errstate(over="ignore", invalid="ignore"):
        deviations = np.abs(matrices @ matrices.swapaxes(-1, -2) - np.eye(3)).max((-2, -1))
        return np.asarray((deviations < ROTATION_TOLERANCE) & (np.linalg.det(matrices) > 0))


def have_unit_length(quaternions: Float[np.ndarray, "n 4"]) -> Bool[np.ndarray, " n"]:
    """Whether each quaternion has length 1, up to `ROTATION_TOLERANCE`, and so is a rotation."""
    with np.errstate(invalid="ignore", over="ignore"):  # NaN and infinity have another length
        return np.abs(np.linalg.norm(quaternions, axis=1) - 1) <= ROTATION_TOLERANCE
