"""A process that publishes point clouds and poses by zenoh, with the keys, attachments and tokens of rmw_zenoh.

Usage: zenoh_talker.py ENDPOINT CLOUD_FILE TF_FILE. It listens there. Lines of the files are messages in hexadecimal.
"""

import json
import struct
import sys
import time
from pathlib import Path

import zenoh

CLOUD = "sensor_msgs::msg::dds_::PointCloud2_/RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
TF = "tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"


def main() -> None:
    endpoint, clouds, transforms = sys.argv[1:]
    config = zenoh.Config()
    for key, value in (("listen/endpoints", [endpoint]), ("scouting/multicast/enabled", False)):
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        tokens = [
            session.liveliness().declare_token(
                f"@ros2_lv/0/{session.zid()}/0/{number}/MP/%/%/talker/%{name}/{kind}/::,5:,:,:,,"
            )
            for number, (name, kind) in enumerate((("points", CLOUD), ("tf", TF)))
        ]
        lines = zip(*(Path(file).read_text().split() for file in (clouds, transforms)), strict=True)
        for step, (cloud, transform) in enumerate(lines):
            about = struct.pack("<qqB16s", step, time.time_ns(), 16, b"talker")
            session.put(f"0/tf/{TF}", bytes.fromhex(transform), attachment=about)
            session.put(f"0/points/{CLOUD}", bytes.fromhex(cloud), attachment=about)
            time.sleep(0.05)
        del tokens


if __name__ == "__main__":
    main()
