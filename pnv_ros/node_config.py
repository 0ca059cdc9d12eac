"""NodeConfig: every setting of the node that is none of the recogniser, declared once."""

from dataclasses import dataclass

from rclpy.exceptions import InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.validate_full_topic_name import validate_full_topic_name
from rclpy.validate_topic_name import validate_topic_name

from pnv_core.errors import ConfigError
from pnv_core.settings import Section, checked, setting


@dataclass(frozen=True)
class NodeConfig:
    """Settings of the node; every instance is valid or raises ConfigError."""

    _inputs = Section("Inputs")
    image_topics: tuple[str, ...] = setting(
        ("camera/image_raw",), "image topics, one per camera; closures name a camera by its index in this list"
    )
    transport: str = setting(
        "auto",
        "message type of the image topics: raw = Image, compressed = CompressedImage, auto = as published",
        choices=("auto", "raw", "compressed"),
    )
    masks: tuple[str, ...] = setting(
        (), "image files, one per camera or one for all; black pixels are ignored (the robot's own body)", kind=str
    )
    crop: tuple[int, ...] = setting(
        (), "pixels cut off at left, top, right, bottom before anything else is done", kind=int, unit="px", low=0
    )
    camera_info_topics: tuple[str, ...] = setting(
        (), "CameraInfo topics, one per camera; images are rectified by them, ~/relative_pose needs them", kind=str
    )
    odometry_topic: str = setting(
        "",
        "nav_msgs/Odometry, z up: rules closures out, scales ~/relative_pose; places keyframes without pose_topic",
    )
    camera_in_base: tuple[float, ...] = setting(
        (),
        "where each camera is on the robot: x, y, z, roll, pitch, yaw of its housing, which looks along x",
        kind=float,
        unit="m, rad",
        low=-100.0,
        high=100.0,
    )
    depth_topics: tuple[str, ...] = setting(
        (), "depth images (16UC1 in mm, 32FC1 in m) aligned to the images, one per camera: poses in metres", kind=str
    )
    pose_topic: str = setting(
        "", "geometry_msgs/PoseStamped of the robot in the map, as from a SLAM: places keyframes, instead of odometry"
    )

    _time = Section("Time")
    on_stamp_back: str = setting(
        "skip",
        "frames whose stamp goes back by 1 s or more (a bag in a loop): skip them, or begin a new session",
        choices=("skip", "new_session"),
    )
    no_image_warning_s: float = setting(
        5.0, "warn when no image came for so long", unit="s", low=0.1, high=1e6, live=True
    )

    _life = Section("Life")
    autostart: bool = setting(True, "configure and activate at start; false leaves that to a life-cycle manager")
    map_path: str = setting("", "folder that ~/save writes and ~/load reads", live=True)
    load_on_start: bool = setting(False, "load map_path when configuring, if there is a map")
    autosave: bool = setting(False, "save to map_path every autosave_interval_s, at shutdown and at clean-up")
    autosave_interval_s: float = setting(300.0, "time between autosaves", unit="s", low=1.0, high=1e6)
    localization: bool = setting(False, "localise in the loaded map: nothing is added to it, fixes go out on ~/pose")
    lost_after_s: float = setting(5.0, "lost when images of so long gave no fix", unit="s", low=0.1, high=1e6)

    _outputs = Section("Outputs")
    publish_candidates: bool = setting(True, "publish ~/candidates while somebody subscribes", live=True)
    publish_markers: bool = setting(True, "publish ~/markers while somebody subscribes", live=True)
    publish_match_image: bool = setting(True, "publish ~/match_image while somebody subscribes", live=True)
    publish_lio_sam: bool = setting(True, "publish ~/lio_sam: closures within this run", live=True)
    lio_sam_interval_s: float = setting(
        1.0, "least time between the queries of ~/lio_sam", unit="s", low=0.0, high=1e6, live=True
    )
    lio_sam_gap_s: float = setting(
        30.0, "least time between query and match of ~/lio_sam", unit="s", low=0.0, high=1e6, live=True
    )
    frame_id: str = setting("map", "frame of ~/pose, and of ~/markers where poses name none", live=True)

    # Fleet
    fleet_uri: str = setting(
        "", "places shared between robots: http(s)://HOST:PORT (Milvus) or a file NAME.db (Milvus Lite); empty = none"
    )
    fleet_robot: str = setting("", "this robot's name in the fleet; empty = the node's namespace, else the host's name")
    fleet_budget_ms: float = setting(
        500.0, "a keyframe the fleet could not be asked for in so long is asked for later", unit="ms", low=1.0, high=1e6
    )
    fleet_coverage: float = setting(
        1.0,
        "a keyframe is not sent where an accepted closure with the fleet is as similar as this; 1 = all are sent",
        low=0.0,
        high=1.0,
    )
    fleet_pictures: bool = setting(False, "send the small grey pictures too; false sends local features alone")
    fleet_keep_days: float = setting(
        0.0,
        "this robot's places are forgotten, once an hour, when its newest image is so much newer; 0 = never",
        unit="days",
        low=0.0,
        high=1e5,
    )
    fleet_kb_s: float = setting(
        0.0, "bound on what is sent, less what is received; 0 = none", unit="kB/s", low=0.0, high=1e6
    )
    fleet_outbox: str = setting("", "folder of what is not sent yet; empty = ~/.local/state/pnv_ros")
    fleet_outbox_mb: float = setting(
        1000.0, "bound on what is not sent yet; when full, the oldest goes", unit="MB", low=1.0, high=1e6
    )

    def __post_init__(self) -> None:
        checked(self)
        topics = self.image_topics
        if not topics or "" in topics or len(set(topics)) != len(topics):
            raise ConfigError(f"image_topics = {list(topics)}; allowed: one or more different topic names")
        if len(self.crop) not in (0, 4):
            raise ConfigError(f"crop = {list(self.crop)} has {len(self.crop)} entries; allowed: 0 or 4")
        if len(self.masks) not in (0, 1, len(topics)):
            raise ConfigError(f"masks has {len(self.masks)} entries; allowed: 0, 1 or one per image topic")
        if len(self.camera_info_topics) not in (0, len(topics)):
            raise ConfigError(
                f"camera_info_topics has {len(self.camera_info_topics)} entries; allowed: 0 or one per image topic"
            )
        if len(self.camera_in_base) not in (0, 6 * len(topics)):
            raise ConfigError(
                f"camera_in_base has {len(self.camera_in_base)} entries; "
                "allowed: 0 or x, y, z, roll, pitch, yaw per image topic"
            )
        if len(self.depth_topics) not in (0, len(topics)):
            raise ConfigError(f"depth_topics has {len(self.depth_topics)} entries; allowed: 0 or one per image topic")
        if self.depth_topics and not self.camera_info_topics:
            raise ConfigError("depth_topics is given without camera_info_topics; allowed: both, or none")
        if not self.frame_id.strip():
            raise ConfigError(f"frame_id = {self.frame_id!r}; allowed: the name of a frame")
        for name in ("image_topics", "camera_info_topics", "depth_topics", "odometry_topic", "pose_topic"):
            given = getattr(self, name)
            for topic in given if isinstance(given, tuple) else filter(None, [given]):
                _check_topic(name, topic)
        for name in ("load_on_start", "autosave", "localization"):
            if getattr(self, name) and not self.map_path:
                raise ConfigError(f"{name} is true but map_path is empty; allowed: a folder")


def _check_topic(name: str, topic: str) -> None:
    try:
        validate_topic_name(topic)
        validate_full_topic_name(expand_topic_name(topic, "node", "/"))
    except (InvalidTopicNameException, ValueError) as error:
        why = str(error).splitlines()[0].removeprefix("Invalid topic name: ").split(", at ")[0].rstrip(":")
        raise ConfigError(
            f"{name} names {topic!r}: {why}; allowed: letters, digits, _ and /, as in camera/image_raw"
        ) from None
