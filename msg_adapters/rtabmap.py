"""What RTAB-Map says of its graph, and the links it is given. Only attributes are read."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.metric_closures import MetricClosure
from msg_adapters.poses import transform_of
from msg_adapters.stamp_ids import NodePair
from pnv_core.rotations import local_covariance

USER_CLOSURE = 4  # rtabmap::Link::kUserClosure


def node_stamps(map_data: Any) -> dict[int, int]:
    """Stamps in nanoseconds by id of the nodes in a rtabmap_msgs/MapData; landmarks have negative ids."""
    return {node.id: round(node.stamp * 1e9) for node in map_data.nodes if node.id > 0 and node.stamp > 0}


def fill_link(link: Any, pair: NodePair, metric: MetricClosure, m_per_s: float) -> Any:
    """A rtabmap_msgs/Link from the match's node to the query's; its transform is the query's pose in the match.

    Nodes are other moments than the images: what the robot may have moved meanwhile, at `m_per_s`, is added to the
    variance of the position.
    """
    covariance: NDArray[np.float64] = metric.covariance.copy()
    moved = m_per_s * np.array([pair.query_offset_ns, pair.match_offset_ns]) / 1e9
    covariance[:3, :3] += np.eye(3) * float((moved**2).sum())
    link.from_id, link.to_id, link.type = pair.match, pair.query, USER_CLOSURE
    link.transform = transform_of(metric.relative)
    link.information = np.linalg.inv(local_covariance(covariance, metric.relative)).ravel()
    return link


def why_not_in(map_data: Any, match: int, query: int) -> str:
    """Why RTAB-Map has no link between two nodes, by the whole graph after add_link; empty where it has."""
    if any(link.type == USER_CLOSURE and {link.from_id, link.to_id} == {match, query} for link in map_data.graph.links):
        return ""
    absent = [node for node in (match, query) if node not in map_data.graph.poses_id]
    if absent:
        return f"node {absent[0]} is not in its graph"
    return "the link contradicts its graph (RGBD/OptimizeMaxError)"
