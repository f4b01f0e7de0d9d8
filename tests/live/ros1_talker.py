"""A process of Debian's Python that publishes point clouds and tf, and prints received results, with rospy's classes.

Usage: ros1_talker.py CLOUD_TYPE. It prints a line for each loop, marker and transform.
"""

import struct
import sys

import rospy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from sensor_msgs.msg import LaserScan, PointCloud2, PointField
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

COUNT = 20
"""Points of a cloud, whose coordinates count from 0."""


def say(*words):
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


def cloud(seconds):
    found = PointCloud2(height=1, width=COUNT, point_step=12, row_step=12 * COUNT, is_dense=True)
    found.header.stamp, found.header.frame_id = rospy.Time.from_sec(seconds), "lidar"
    found.fields = [PointField(name, 4 * at, PointField.FLOAT32, 1) for at, name in enumerate("xyz")]
    found.data = struct.pack(f"<{3 * COUNT}f", *range(3 * COUNT))
    return found


def transform(seconds, frame, child, x, z):
    found = TransformStamped(child_frame_id=child)
    found.header.stamp, found.header.frame_id = rospy.Time.from_sec(seconds), frame
    found.transform.translation.x, found.transform.translation.z, found.transform.rotation.w = x, z, 1.0
    return TFMessage([found])


def main():
    kind = {"PointCloud2": PointCloud2, "LaserScan": LaserScan}[sys.argv[1]]
    rospy.init_node("talker", anonymous=True, disable_rosout=True)
    fixed = rospy.Publisher("/tf_static", TFMessage, queue_size=1, latch=True)
    fixed.publish(transform(0, "base", "lidar", 0, 2))
    tf = rospy.Publisher("/odometry", TFMessage, queue_size=5)
    scans = rospy.Publisher("/points", kind, queue_size=5)
    for topic, of, described in (
        ("/sglpr/loops", PoseWithCovarianceStamped, lambda m: ("loop", m.header.frame_id, m.pose.pose.position.x)),
        ("/sglpr/loop_markers", MarkerArray, lambda m: ("markers", len(m.markers[0].points), m.markers[0].ns)),
        ("/tf", TFMessage, lambda m: ("tf", m.transforms[0].header.frame_id, m.transforms[0].child_frame_id)),
    ):
        rospy.Subscriber(topic, of, lambda message, described=described: say(*described(message)))
    for step in range(5000):
        seconds = 100 + step * 0.05
        tf.publish(transform(seconds, "odom", "base", step * 0.1, 0))
        scans.publish(cloud(seconds) if kind is PointCloud2 else kind())
        rospy.sleep(0.05)


if __name__ == "__main__":
    main()
