"""Messages of ROS 2, against rosbags' own decoding."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sglpr_jax.live.data_types import LoopEdge
from sglpr_jax.live.ros_encoding import (
    CLOUD,
    EDGE,
    TRANSFORMS,
    decode_cloud,
    edge_message,
    typestore,
)
from tests.live.messages import LIVOX, POINTS, cloud, decoded, livox

POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("xyz", [0.1, -0.2, 2.0]).as_matrix()
POSE[:3, 3] = 1.5, -2.0, 0.25


def edge(**changed) -> LoopEdge:
    root = np.random.default_rng(3).normal(size=(6, 6))
    fields = LoopEdge(40, 2, 1234.5, 1000.25, POSE, root @ root.T, 0.9, np.eye(4), np.eye(4), 0.01)
    return fields._replace(**changed)


@pytest.mark.parametrize("kind, message", [(CLOUD, cloud()), (LIVOX, livox())])
def test_a_cloud_is_decoded_and_padding_is_ignored(kind, message):
    header, records = decode_cloud(message + b"\0\0\0", kind)
    assert header == (12.5, "lidar")
    np.testing.assert_array_equal(records.points, POINTS)
    assert records.lasers is not None and len(records.lasers) == len(POINTS)


@pytest.mark.parametrize("kind, message", [(CLOUD, cloud()), (LIVOX, livox())])
def test_a_damaged_cloud_is_one_clear_error(kind, message):
    for length in (0, 3, 4, 9, 30, len(message) // 2):
        with pytest.raises(ValueError, match="expected a cloud with points, found"):
            decode_cloud(message[:length], kind)


def test_an_edge_has_times_and_pose_and_its_covariance_is_about_the_axes_of_the_match():
    """Small motions of the query in its own frame, seen as those of its pose in the match's frame."""
    covariance = np.diag([0.4, 0.1, 0.05, 0.002, 0.001, 0.01]) ** 2
    motions = np.random.default_rng(0).multivariate_normal(np.zeros(6), covariance, 20_000)
    turns = Rotation.from_matrix(POSE[:3, :3])
    moved = motions[:, :3] @ POSE[:3, :3].T
    tilted = (turns * Rotation.from_rotvec(motions[:, 3:]) * turns.inv()).as_rotvec()
    expected = np.cov(np.concatenate([moved, tilted], axis=1).T)
    message = decoded(edge_message(edge(covariance=covariance)), EDGE)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1234, 500_000_000)
    assert message.header.frame_id == "match/1000.250000000"
    at, turned = message.pose.pose.position, message.pose.pose.orientation
    np.testing.assert_allclose([at.x, at.y, at.z], POSE[:3, 3])
    turn = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).as_matrix()
    np.testing.assert_allclose(turn, POSE[:3, :3], atol=1e-12)
    found = message.pose.covariance.reshape(6, 6)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.03)


@pytest.mark.parametrize("time", [float("nan"), 1e12])
def test_a_time_that_no_stamp_holds_becomes_zero(time):
    found = decoded(edge_message(edge(query_time=time)), EDGE)
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == (0, 0)


def test_hashes_of_types_are_those_of_ros():
    """As rmw_zenoh of Jazzy has them in its keys."""
    published = {
        CLOUD: "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
        TRANSFORMS: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    }
    assert {kind: typestore().hash_rihs01(kind) for kind in published} == published
