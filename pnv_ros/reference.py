"""config/*.yaml, docs/ros_interface.md and docs/bridges.md, written from the declarations.

python -m pnv_ros.reference    rewrites them in the current checkout
"""

from pathlib import Path
from typing import Any

from msg_adapters.images import ENCODINGS
from msg_adapters.loop_closures import CANDIDATE_FIELDS, COLUMNS
from pnv_core.config import PRESETS
from pnv_core.settings import Setting, settings_of
from pnv_core.types import Reason
from pnv_ros.bridges.config import BRIDGE_SETTINGS
from pnv_ros.inputs import OVERRIDABLE, image_qos, qos_in_words
from pnv_ros.localisation import POSE_QOS
from pnv_ros.markers import MARKERS_QOS
from pnv_ros.outputs import CLOSURES_QOS, PICTURE_QOS, TABLE_QOS
from pnv_ros.parameters import DECLARED, NODE, RECOGNISER, preset_defaults
from pnv_ros.statistics import Drop

REASONS = {
    Reason.ACCEPTED: "accepted",
    Reason.LOW_SCORE: "score below accept_score",
    Reason.LOW_TEXTURE: "the image shows next to nothing (min_texture)",
    Reason.UNCONFIRMED: "neighbouring keyframes do not agree (consistency), or one near the match agrees far better",
    Reason.ODOMETRY: "the jump is impossible by odometry",
    Reason.NOT_RERANKED: "not scored in full, to keep within time_budget_ms",
    Reason.NOT_VERIFIED: "not among the best that local features examined (verify), or too few of them agree",
    Reason.AMBIGUOUS: "a place far from the match is supported about alike, and too few keyframes agree yet",
}
DROPS = {
    Drop.BUSY: "a newer frame of the camera came before the worker was free",
    Drop.STAMP_REPEATED: "the header stamp equals the camera's last one",
    Drop.STAMP_BACK: "the header stamp lies before the camera's last one, or in a run that ended (on_stamp_back)",
    Drop.UNUSABLE: "the message is damaged, of an unknown encoding, or out of size limits",
    Drop.NO_CAMERA_INFO: "camera_info_topics is set and no CameraInfo has come yet",
    Drop.PAUSED: "~/pause",
}


def parameters_yaml(preset: str) -> str:
    """Every parameter with its meaning and limits, at the values of a preset."""
    lines = [
        f"# Every parameter of place_recognizer, at the values of the preset {preset}.",
        "# Written by `python -m pnv_ros.reference`; copy it and keep the lines that you change.",
        "/**:",
        "  ros__parameters:",
    ]
    values = preset_defaults(preset)
    for title, group in (("The recogniser", RECOGNISER), ("The node", NODE)):
        lines += ["", f"    # {title}"]
        for setting in group.values():
            lines += ["", f"    # {_sentence(setting)}"]
            value = _yaml(values[setting.name])
            # an empty list has no type that a parameter file could tell
            lines.append(f"    {'# ' if value == '[]' else ''}{setting.name}: {value}")
    return "\n".join(lines) + "\n"


def interface_markdown() -> str:
    """docs/ros_interface.md."""
    return (
        _PAGE.replace("{image_qos}", qos_in_words(image_qos()))
        .replace("{closures_qos}", f"{qos_in_words(CLOSURES_QOS)}, depth {CLOSURES_QOS.depth}")
        .replace("{table_qos}", f"{qos_in_words(TABLE_QOS)}, depth {TABLE_QOS.depth}")
        .replace("{pose_qos}", f"{qos_in_words(POSE_QOS)}, depth {POSE_QOS.depth}")
        .replace("{picture_qos}", f"{qos_in_words(PICTURE_QOS)}, depth {PICTURE_QOS.depth}")
        .replace("{markers_qos}", f"{qos_in_words(MARKERS_QOS)}, depth {MARKERS_QOS.depth}")
        .replace("{overridable}", ", ".join(k.name.lower() for k in OVERRIDABLE))
        .replace("{encodings}", ", ".join(f"`{e}`" for e in ENCODINGS))
        .replace("{columns}", ", ".join(f"`{c}`" for c in COLUMNS))
        .replace("{candidate_fields}", ", ".join(f"`{f}`" for f in CANDIDATE_FIELDS))
        .replace("{reasons}", _table(("code", "reason", "meaning"),
                                     [(i, f"`{r}`" if r else "(none)", REASONS[r]) for i, r in enumerate(Reason)]))
        .replace("{drops}", _table(("reason", "meaning"), [(f"`{d}`", DROPS[d]) for d in Drop]))
        .replace("{parameters}", _table(
            ("parameter", "default", "meaning", "allowed", "live"),
            [(f"`{s.name}`", f"`{_yaml(s.default)}`", s.doc, s.allowed(), "yes" if s.live else "")
             for s in DECLARED.values()]))
    )  # fmt: skip


def bridges_markdown() -> str:
    """docs/bridges.md."""
    parts = ["# Parameters of the bridges\n\nWritten by `python -m pnv_ros.reference`; see [backends](backends.md).\n"]
    for name, kind in BRIDGE_SETTINGS.items():
        rows = [(f"`{s.name}`", f"`{_yaml(s.default)}`", s.doc, s.allowed()) for s in settings_of(kind).values()]
        parts.append(f"\n## {name}\n\n{_table(('parameter', 'default', 'meaning', 'allowed'), rows)}\n")
    return "".join(parts)


def files(root: Path) -> dict[Path, str]:
    """What the reference files of a checkout must contain."""
    return {root / "config" / f"{preset}.yaml": parameters_yaml(preset) for preset in PRESETS} | {
        root / "docs" / "ros_interface.md": interface_markdown(),
        root / "docs" / "bridges.md": bridges_markdown(),
    }


def _sentence(setting: Setting) -> str:
    live = "may change while running" if setting.live else "needs a restart"
    return f"{setting.doc}. {setting.allowed()}; {live}"


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_yaml(v) for v in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    cells = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(str(c) for c in row) + " |" for row in cells)


_PAGE = """\
# ROS interface of place_recognizer

Written by `python -m pnv_ros.reference` from the code's own declarations; a test keeps it so.
Names without a leading slash are relative to the node's namespace, `~` is the node's own name.

## Subscribed topics

| topic | type | QoS | what |
| --- | --- | --- | --- |
| `image_topics` (`camera/image_raw`) | sensor_msgs/Image or CompressedImage | {image_qos}, depth 2 | the cameras |
| `camera_info_topics` (none) | sensor_msgs/CameraInfo | best effort, volatile | optional; images are rectified by it |
| `depth_topics` (none) | sensor_msgs/Image | best effort, volatile | optional; poses in metres |
| `odometry_topic` (none) | nav_msgs/Odometry | best effort, volatile | optional; rules closures out, places keyframes |
| `pose_topic` (none) | geometry_msgs/PoseStamped | best effort, volatile | optional; places keyframes, in the map |

A CameraInfo is taken anew whenever it changes, and refused where no camera has such numbers; one that was published
once and is kept (transient local) is asked for. Images of a topic with a part `image_rect...` in its name are taken as
rectified: they stay as they are, and their `P` counts. Odometry is believed in so far as it follows: less than 0.2 m is
no way gone, and a sample that no robot can reach is not taken until two others have followed it, when another run
begins.

`transport: auto` takes the message type that is published. Of Image these encodings are understood: {encodings};
row padding and byte order are honoured. CompressedImage is jpeg or png, 8 or 16 bit. Sides are 16 to 16384 pixels, 67
megapixels at most; a compressed image is measured by its header before anything is unpacked. 16 bit pixels, of messages
and of files, are scaled by the smallest of 8, 10, 12, 14 and 16 bits that holds all but a thousandth of the frame's
pixels: a 12 bit camera's frames keep their brightness whatever hot pixels there are, and one dark enough for fewer bits
is brightened.

Uncompressed images of more than a few hundred kilobytes need a larger shared memory segment than Fast DDS has by
default: set `FASTRTPS_DEFAULT_PROFILES_FILE` to `config/fastdds_shared_memory.xml` for camera and node. The node tells
from the stamps how many frames are lost. With `transport: auto` it goes over to the JPEGs of `TOPIC/compressed`, as
image_transport publishes them, where a sixth or more is lost; where there are none, the log and /diagnostics say what
to set. JPEGs are decoded at a half, a quarter or an eighth where that is as large as what is looked at, unless `crop`
or a CameraInfo counts pixels.

The QoS of each image topic can be set by rclpy's overrides
(`qos_overrides./camera/image_raw.subscription.reliability: reliable`): {overridable}. A publisher that does not
match is reported with both profiles and the override to set.

## Published topics

| topic | type | QoS | when |
| --- | --- | --- | --- |
| `loop_closures` | std_msgs/Float64MultiArray | {closures_qos} | per query with an accepted closure |
| `~/closures` | pnv_msgs/LoopClosureArray | {closures_qos} | as `loop_closures`, where pnv_msgs is installed |
| `~/lio_sam` | std_msgs/Float64MultiArray | {table_qos} | best closure, limited by `lio_sam_interval_s` |
| `~/relative_pose` | geometry_msgs/PoseWithCovarianceStamped | {table_qos} | best closure, where its scale is known |
| `~/pose` | geometry_msgs/PoseWithCovarianceStamped | {pose_qos} | per fix, with `localization: true` |
| `initialpose` | geometry_msgs/PoseWithCovarianceStamped | {pose_qos} | on `~/relocalize` |
| `~/candidates` | sensor_msgs/PointCloud2 | {table_qos} | per query, while somebody subscribes |
| `~/match_image` | sensor_msgs/Image | {picture_qos} | per query, while somebody subscribes |
| `~/markers` | visualization_msgs/MarkerArray | {markers_qos} | on change, while somebody subscribes |
| `/diagnostics` | diagnostic_msgs/DiagnosticArray | reliable, volatile, depth 10 | once a second |

**`loop_closures`**: rows best first; `layout.dim[0]` is ("closures", N, N * C), `layout.dim[1]` is (the column names
joined by commas, C, C). Columns: {columns}. Columns 0 and 1 are epoch seconds of the image headers, query newer,
match older; the exact stamp is (floor(column 0), column 5) and (floor(column 1), column 6). Cameras are indices into
`image_topics`; -1 is a camera of a loaded map that is not among them. Columns are only ever appended.
`msg_adapters.loop_closures.closures_from_message` reads it.

**`~/closures`**: the typed twin of `loop_closures`, the same closures at the same moments, with cameras by name,
session and robot (the node's namespace), and the relative pose of the best one while somebody subscribes. It is
published where the package pnv_msgs can be imported; all else works without it. `pnv_msgs/msg` explains the fields.

**`~/lio_sam`**: exactly two doubles, query and match in epoch seconds, at least `lio_sam_gap_s` apart and
of the same session: LIO-SAM knows the stamps of its own run only, so nothing is sent about the places of a loaded map.

**`~/relative_pose`**: the query's camera (optical frame) in the frame `keyframe_<match id>`, in metres. It needs
`camera_info_topics` and a scale: `depth_topics` here or when the keyframe was taken, a stereo pair (two image topics
whose CameraInfo says in P how far apart they are), or the way of `odometry_topic` between two images. Where no scale is
known none is sent; `~/closures` then carries rotation and direction. Sent while somebody subscribes. The covariance is
about the axes of the match's frame. With `localization` the closures' queries are no keyframes (their id is -1) and do
not appear in `~/markers`.

**`~/pose`**, with `localization: true`: the robot (the base that `camera_in_base` speaks of) in the frame of the map's
poses, named `frame_id`, at every image that gave a fix: an accepted closure with a metric pose, of a keyframe that has
one itself. Keyframes have the poses that `pose_topic`, or else `odometry_topic`, gave while the map was made; those of
odometry count for the map's first session, since every later one began elsewhere. The covariance is that of the sight:
what the map's own poses are worth is not known. Nothing vaguer is sent: where nothing is recognised, or no scale or
pose is known, `/diagnostics` says `lost` and why, and always the time since the last fix.

**`~/candidates`**: every candidate examined, refused ones too, one point each: {candidate_fields}. Reasons:

{reasons}

## Services

| service | type | what |
| --- | --- | --- |
| `~/save` | std_srvs/Trigger | write the map to `map_path` |
| `~/load` | std_srvs/Trigger | replace the map by the one at `map_path`; a new session begins |
| `~/reset` | std_srvs/Trigger | forget every keyframe, and the stamps seen |
| `~/relocalize` | std_srvs/Trigger | publish the last fix on `initialpose`; refused where the robot is lost |
| `~/pause` | std_srvs/SetBool | drop images until set to false; the map is kept |
| `~/save_map` | pnv_msgs/SaveMap | `~/save` to another path this once |
| `~/load_map` | pnv_msgs/LoadMap | `~/load` from another path this once |
| `~/query_image` | pnv_msgs/QueryImage | the candidates of an image; nothing is added, no keyframe is too young |
| `~/get_keyframe` | pnv_msgs/GetKeyframe | what a keyframe keeps: image, global vector, small picture |

Those of pnv_msgs are there where pnv_msgs is on the machine. A single image is accepted from `sure_score` on.

Images go on being processed while a map is written or read; `~/load` and `~/reset` wait for the frame in hand.
`autosave` without `load_on_start` is refused where `map_path` already holds a map, since a map that was not loaded is
never overwritten. A map that this run saved and then left by `~/reset` or `~/load` is kept in a folder beside,
`<map_path>.before-1` and so on, when another one is saved in its place. An autosave that fails turns `/diagnostics` to
ERROR until one succeeds; where the last one fails, the node ends with status 1.

## Life cycle

The node is a managed node (`ros2 lifecycle set /place_recognizer configure`, and so on). Configure loads the model and
says why where it cannot; activate subscribes; deactivate stops and keeps the map; clean-up frees it. With `autostart`
(the default) it configures and activates itself, and ends with status 2 where that fails. SIGINT and SIGTERM end it
after the frame in hand with status 0; a failure while running ends it with the traceback and status 1.

## Time

Only header stamps count, never the wall clock. The stamps of a camera must rise. A frame whose stamp repeats is
skipped. A frame whose stamp goes back by less than a second is late and skipped. One that goes back further is
skipped too (`on_stamp_back: skip`), until the stamps pass the last one or `~/reset` is called, or begins a new session
(`on_stamp_back: new_session`), against whose predecessors closures are then found. Other cameras join that session when
their stamps go back too; what they show of the run before until then is skipped. Each is said once in the log.
`use_sim_time` stamps /diagnostics; nothing else depends on a clock.

Frames that are received and not processed are counted in `/diagnostics`:

{drops}

## Parameters

Those marked live can change while the node runs, several at once or none at all; the others can change before
configure. `config/` has a file of them per preset. The defaults are those of `preset: default`.

{parameters}
"""


def main() -> None:
    for path, text in files(Path.cwd()).items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        print(path)


if __name__ == "__main__":
    main()
