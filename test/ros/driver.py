"""A driver like those of other packages: plain rclpy, without the package's Fast DDS profile.

python driver.py TOPIC reliable|best_effort COUNT HZ POINTS FIRST_STAMP
"""

import array
import sys
from time import monotonic, sleep

import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField

topic, reliability, (count, hz, points, first) = *sys.argv[1:3], map(int, sys.argv[3:])
rclpy.init()
node = rclpy.create_node("driver")
publisher = node.create_publisher(
    PointCloud2, topic, QoSProfile(depth=5, reliability=ReliabilityPolicy[reliability.upper()])
)
street = np.random.default_rng(0).uniform(-40, 40, (points, 4)).astype(np.float32)
street[:, 2] = -1.73 + street[:, 2] / 2000
data = array.array("B")
data.frombytes(street.tobytes())
cloud = PointCloud2(
    height=1,
    width=points,
    point_step=16,
    row_step=16 * points,
    data=data,
    is_dense=True,
    fields=[
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate(("x", "y", "z", "intensity"))
    ],
)
cloud.header.frame_id = "driver_lidar"
while publisher.get_subscription_count() == 0:
    rclpy.spin_once(node, timeout_sec=0.05)
start = monotonic()
for i in range(count):
    cloud.header.stamp.sec = first + i
    sleep(max(0.0, start + i / hz - monotonic()))
    publisher.publish(cloud)
print("sent", flush=True)
sys.stdin.readline()  # keep the writer alive, because it may resend clouds to reliable subscribers
node.destroy_node()
rclpy.try_shutdown()
