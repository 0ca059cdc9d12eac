"""The node's part in a fleet: settings in, closures with other robots' places out."""

import os
import socket
from pathlib import Path

from rclpy.node import Node

from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import PlaceDescriptor
from pnv_fleet.fleet import Fleet, Options
from pnv_ros.node_config import NodeConfig
from pnv_ros.outputs import Outputs


def start_fleet(
    node: Node, config: NodeConfig, recognizer: PlaceRecognizer, like: PlaceDescriptor, outputs: Outputs
) -> Fleet:
    """The threads that keep, ask and send. Raises FleetError for a name or an outbox that cannot be used."""
    robot = config.fleet_robot or node.get_namespace().strip("/") or socket.gethostname()
    describer = recognizer.describer
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "pnv_ros"
    folder = Path(config.fleet_outbox) if config.fleet_outbox else state
    file = f"{robot.replace('/', '_')}-{describer.map_fingerprint[:12]}.outbox"
    fleet = Fleet(
        Options(
            config.fleet_uri, robot, config.fleet_budget_ms, folder / file, config.fleet_outbox_mb, config.fleet_kb_s,
            config.fleet_coverage, config.fleet_pictures, config.fleet_keep_days,
        ),
        describer.config,
        describer.map_fingerprint,
        like,
        describer.model.info.calibration,
        outputs.publish_fleet,
        node.get_logger().info,
    )  # fmt: skip
    fleet.sessions(recognizer.database.refs())
    return fleet
