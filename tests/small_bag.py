"""Tiny rosbags: a robot with one camera, one LiDAR, odometry and their mounts."""

import io
from pathlib import Path

import numpy as np
from PIL import Image
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
STORES[1].register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
IMAGE, INFO, POINTS, SCAN, ODOM, TF = "/cam/image", "/cam/camera_info", "/points", "/scan", "/odom", "/tf_static"
PHOTO = (40, 60)  # rows, columns
BEGIN = 100_000_000_000  # [ns]
OPTICAL = (-0.5, 0.5, -0.5, 0.5)  # x, y, z, w: looks along x, level


class Maker:
    """Messages of ROS 1 or 2."""

    def __init__(self, ros: int = 2):
        self.ros, self.store = ros, STORES[ros]

    def new(self, kind, **fields):
        if self.ros == 1 and kind == "std_msgs/msg/Header":
            fields["seq"] = 0
        if self.ros == 1 and kind == "sensor_msgs/msg/CameraInfo":
            fields = {name.upper() if len(name) == 1 else name: value for name, value in fields.items()}
        return self.store.types[kind](**fields)

    def header(self, ns, frame):
        stamp = self.new("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def image(self, ns, photo, frame="camera"):
        return self.new(
            "sensor_msgs/msg/Image", header=self.header(ns, frame), height=photo.shape[0], width=photo.shape[1],
            encoding="rgb8", is_bigendian=0, step=3 * photo.shape[1], data=photo.ravel(),
        )  # fmt: skip

    def compressed(self, ns, photo, frame="camera"):
        held = io.BytesIO()
        Image.fromarray(photo).save(held, "PNG")
        data = np.frombuffer(held.getvalue(), np.uint8)
        return self.new("sensor_msgs/msg/CompressedImage", header=self.header(ns, frame), format="png", data=data)

    def info(self, ns, shape=PHOTO, focal=30.0, frame="camera", d=(0.0,) * 5, model="plumb_bob"):
        k = np.array([focal, 0, shape[1] / 2 - 0.5, 0, focal, shape[0] / 2 - 0.5, 0, 0, 1.0])
        roi = self.new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.new(
            "sensor_msgs/msg/CameraInfo", header=self.header(ns, frame), height=shape[0], width=shape[1],
            distortion_model=model, d=np.array(d), k=k, r=np.eye(3).ravel(),
            p=np.insert(k.reshape(3, 3), 3, 0.0, axis=1).ravel(), binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip

    def cloud(self, ns, points, frame="lidar"):
        points = np.asarray(points, np.float32)
        field = lambda k, n: self.new("sensor_msgs/msg/PointField", name=n, offset=4 * k, datatype=7, count=1)  # noqa: E731
        fields = [field(k, n) for k, n in enumerate("xyz")]
        return self.new(
            "sensor_msgs/msg/PointCloud2", header=self.header(ns, frame), height=1, width=len(points), fields=fields,
            is_bigendian=False, point_step=12, row_step=12 * len(points), data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=False,
        )  # fmt: skip

    def scan(self, ns, ranges, frame="lidar", range_min=0.1, range_max=20.0):
        ranges = np.asarray(ranges, np.float32)
        return self.new(
            "sensor_msgs/msg/LaserScan", header=self.header(ns, frame), angle_min=-1.0, angle_max=1.0,
            angle_increment=2.0 / (len(ranges) - 1), time_increment=0.0, scan_time=0.1, range_min=range_min,
            range_max=range_max, ranges=ranges, intensities=np.zeros(0, np.float32),
        )  # fmt: skip

    def odometry(self, ns, pose, twist, child="base_link"):
        x, y, yaw = pose
        vector = lambda *v: self.new("geometry_msgs/msg/Vector3", **dict(zip("xyz", v, strict=True)))  # noqa: E731
        at = self.new(
            "geometry_msgs/msg/Pose", position=self.new("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
            orientation=self.quaternion(0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)),
        )  # fmt: skip
        speed = self.new("geometry_msgs/msg/Twist", linear=vector(twist[0], 0.0, 0.0), angular=vector(0.0, 0.0, twist[1]))
        return self.new(
            "nav_msgs/msg/Odometry", header=self.header(ns, "odom"), child_frame_id=child,
            pose=self.new("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.zeros(36)),
            twist=self.new("geometry_msgs/msg/TwistWithCovariance", twist=speed, covariance=np.zeros(36)),
        )  # fmt: skip

    def quaternion(self, x, y, z, w):
        return self.new("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))

    def tf(self, *edges, ns=BEGIN):
        """Of (parent, child, xyz, quaternion)."""
        stamped = [
            self.new(
                "geometry_msgs/msg/TransformStamped", header=self.header(ns, parent), child_frame_id=child,
                transform=self.new(
                    "geometry_msgs/msg/Transform", rotation=self.quaternion(*q),
                    translation=self.new("geometry_msgs/msg/Vector3", x=t[0], y=t[1], z=t[2]),
                ),
            )
            for parent, child, t, q in edges
        ]  # fmt: skip
        return self.new("tf2_msgs/msg/TFMessage", transforms=stamped)


MOUNTS = (("base_link", "camera", (0.3, 0.0, 0.6), OPTICAL), ("base_link", "lidar", (0.1, -0.2, 0.5), (0.0, 0.0, 0.0, 1.0)))


def write(path: Path, messages, ros: int = 2) -> Path:
    """A bag of (topic, time [ns], message)."""
    make = Maker(ros)
    opened = rosbag1.Writer(path) if ros == 1 else rosbag2.Writer(path, version=9)
    with opened as bag:
        connections = {}
        for topic, ns, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=make.store)
            encode = make.store.serialize_ros1 if ros == 1 else make.store.serialize_cdr
            bag.write(connections[topic], ns, encode(message, kind))
    return path


def photo_of(k: int, shape=PHOTO) -> np.ndarray:
    """A photo whose colour names it."""
    return np.full((*shape, 3), (40 * k + 10, 100, 200 - 30 * k), np.uint8)


CLOUD = np.array([[2.0, 0.0, 0.1], [np.nan, 1.0, 0.0], [3.0, 1.5, -0.2], [-4.0, 0.5, 0.3]])


def drive(count: int = 3, ros: int = 2, every: int = 100_000_000, without=(), **changes) -> list:
    """Messages of a drive at 1 m/s along x: the cloud's times are full steps, images lag by 10 ms, odometry leads by 20.

    Args:
        count: Of clouds.
        ros: 1 or 2.
        every: Step [ns].
        without: Topics that are left out.
        changes: "points", "image", "info", "odometry" or "tf": what makes a message from (maker, number, ns).
    """
    make = Maker(ros)
    usual = {
        "tf": lambda m, k, ns: m.tf(*MOUNTS) if k == 0 else None,
        "info": lambda m, k, ns: m.info(ns),
        "odometry": lambda m, k, ns: m.odometry(ns + 20_000_000, (0.1 * k, 0.5, 0.3), (1.0, 0.2)),
        "image": lambda m, k, ns: m.image(ns - 10_000_000, photo_of(k)),
        "points": lambda m, k, ns: m.cloud(ns, CLOUD),
    } | changes
    topics = {"tf": TF, "info": INFO, "odometry": ODOM, "image": IMAGE, "points": POINTS}
    found = []
    for k in range(count):
        ns = BEGIN + k * every
        for name, message in usual.items():
            made = None if topics[name] in without else message(make, k, ns)
            if made is not None:
                found.append((topics[name], ns, made))
    return found
