"""Each bridge as its own process against a twin of its consumer, written from the behaviour of the named source file.

The camera looks ahead from the body, so a query one metre ahead of its match is at x = 1 in the match's body.
"""

import signal
import sys
from itertools import count

import numpy as np
import pytest
from std_msgs.msg import Float64MultiArray

from msg_adapters.poses import matrix_of_pose, matrix_of_transform
from pnv_ros.outputs import TABLE_QOS
from test.bridges.running import METRIC, Recogniser, S, closure, odometry_message, running
from test.ros.processes import Process, wait_until

pytestmark = pytest.mark.process
PACKAGES = ("rtabmap_msgs", "pose_graph_tools_msgs", "cslam_common_interfaces")
AHEAD = np.array([1.0, 0.0, 0.0])
READY = "hands on /loop_closures"


class RtabMap:
    """rtabmap_slam/src/CoreWrapper.cpp and corelib/src/Rtabmap.cpp: nodes by id with stamps, add_link with an empty
    response, links dropped silently where a node is not in working memory or the graph error is too large."""

    def __init__(self, node, ids, first_stamp_s=100, lost=0):
        from rtabmap_msgs.msg import MapData
        from rtabmap_msgs.srv import AddLink, GetMap

        self._map_data, self.asked, self.links = MapData, [], []
        self.stamps = {i: float(first_stamp_s + i) for i in ids}
        self.memory = set(ids)
        self._published = node.create_publisher(MapData, "/rtabmap/mapData", 10)
        self._services = [
            node.create_service(AddLink, "/rtabmap/rtabmap/add_link", self._add_link),
            node.create_service(GetMap, "/rtabmap/rtabmap/get_map_data", self._get_map),
        ]
        answer, number = self._services[1].send_response, count()
        self._services[1].send_response = lambda *given: answer(*given) if next(number) >= lost else None

    def publish(self, *ids):
        self._published.publish(self._data(ids))

    def _data(self, ids):
        from rtabmap_msgs.msg import Node

        data = self._map_data(nodes=[Node(id=i, stamp=self.stamps[i]) for i in ids])
        data.graph.poses_id, data.graph.links = sorted(self.memory), list(self.links)
        return data

    def _add_link(self, request, response):
        self.asked.append(request.link)
        error = np.linalg.norm(matrix_of_transform(request.link.transform)[:3, 3])
        if {request.link.from_id, request.link.to_id} <= self.memory and error < 3.0:
            self.links.append(request.link)
        return response

    def _get_map(self, request, response):
        response.data = self._data(sorted(self.memory))
        return response


def test_rtabmap_gets_links_between_its_nodes_and_its_silent_refusals_are_said(listener):
    with running("rtabmap_bridge", READY) as bridge:
        recogniser = Recogniser(listener, "/rtabmap_bridge")
        recogniser.say(closure(150 * S, 110 * S))  # before RTAB-Map is there
        twin = RtabMap(listener.node, range(1, 60))
        wait_until(lambda: len(twin.links) == 1, 60, "the first link")
        link = twin.links[0]
        assert (link.from_id, link.to_id, link.type) == (10, 50, 4)
        np.testing.assert_allclose(matrix_of_transform(link.transform)[:3, 3], AHEAD, atol=1e-6)
        assert np.reshape(link.information, (6, 6))[0, 0] == pytest.approx(100.0)

        recogniser.say(closure(round(152.4 * S), 112 * S))  # 0.4 s beside a node, at 0.5 m/s: 0.2 m more
        wait_until(lambda: len(twin.links) == 2, 60, "the second link")
        assert np.reshape(twin.links[1].information, (6, 6))[0, 0] == pytest.approx(1 / (0.01 + 0.2**2))

        twin.memory.discard(20)  # transferred to long term memory
        recogniser.say(closure(155 * S, 120 * S))
        bridge.wait_for("did not keep the link 20 -> 55: node 20 is not in its graph")
        far = type(METRIC)(METRIC.rotation, np.array([0.0, 0.0, 50.0]), True, 30, METRIC.covariance)
        recogniser.say(closure(156 * S, 121 * S), far)
        bridge.wait_for("did not keep the link 21 -> 56: the link contradicts its graph (RGBD/OptimizeMaxError)")

        recogniser.say(closure(157 * S, 30 * S))  # no node at the match
        recogniser.say(closure(158 * S, 125 * S), None)  # no measured pose
        twin.stamps |= {i: 100.0 + i for i in range(60, 80)}
        twin.memory |= set(range(60, 80))
        twin.publish(*range(60, 80))
        bridge.wait_for("no node within 0.5 s of the match")

        twin.stamps = {1: 900.0, 2: 940.0}
        twin.memory = {1, 2}
        twin.publish(1)
        bridge.wait_for("RTAB-Map was restarted")
        recogniser.say(closure(940 * S, 900 * S))
        twin.publish(2)
        wait_until(lambda: len(twin.links) == 3, 60, "a link in the new graph")
        assert (twin.links[2].from_id, twin.links[2].to_id) == (1, 2)
        wait_until(lambda: len(twin.asked) == 5, 60, "every request")
        assert bridge.end(signal.SIGINT) == 0
    assert "Traceback" not in bridge.output
    assert "5 sent, 1 without a measured pose, 0 poses without a usable covariance, 1 without a node" in bridge.output
    assert "1 refused: a node is not in its graph, 1 refused: the link contradicts its graph" in bridge.output


def test_rtabmap_is_asked_for_its_nodes_again_where_its_answer_is_lost(listener):
    with running("rtabmap_bridge", READY) as bridge:
        recogniser = Recogniser(listener, "/rtabmap_bridge")
        twin = RtabMap(listener.node, range(1, 60), lost=1)
        recogniser.say(closure(150 * S, 110 * S))
        wait_until(lambda: len(twin.links) == 1, 60, "the link")
        assert bridge.end() == 0
        assert "1 sent" in bridge.output


def test_hydra_gets_edges_from_the_query_to_the_match(listener):
    """hydra/src/backend/external_loop_closure_receiver.cpp: stamps in ns as keys, nearest node, to_T_from."""
    from pose_graph_tools_msgs.msg import PoseGraph

    graphs = listener.collect(PoseGraph, "/hydra/external_loop_closures", 100)
    nodes = {i: i * S for i in range(1, 60)}  # of the agent's layer
    remap = ("-r", "external_loop_closures:=/hydra/external_loop_closures")
    with running("hydra_bridge", READY, *remap, robot_id=2) as bridge:
        recogniser = Recogniser(listener, "/hydra_bridge")
        for i in range(40, 50):
            recogniser.say(closure(i * S + 200_000_000, (i - 30) * S))
        recogniser.say(closure(55 * S, 5 * S), None)
        wait_until(lambda: len(graphs) == 10, 60, "every edge")
        assert bridge.end() == 0
    inserted = []
    for edge in (edge for graph in graphs for edge in graph.edges):
        to_node, from_node = (min(nodes, key=lambda n: abs(nodes[n] - key)) for key in (edge.key_to, edge.key_from))
        assert (edge.robot_from, edge.robot_to) == (2, 2)
        inserted.append((to_node, from_node))
        np.testing.assert_allclose(matrix_of_pose(edge.pose)[:3, 3], AHEAD, atol=1e-6)  # the query as seen by the match
    assert inserted == [(i - 30, i) for i in range(40, 50)]
    assert "ended: 10 sent, 1 without a measured pose" in bridge.output


def test_covariances_that_are_none_and_a_restart_of_either_side_are_said_and_lose_nothing_that_was_sent(listener):
    from pose_graph_tools_msgs.msg import PoseGraph

    graphs = listener.collect(PoseGraph, "/external_loop_closures", 100)
    with running("hydra_bridge", READY) as bridge:
        recogniser = Recogniser(listener, "/hydra_bridge")
        for query, wrong in ((40, np.nan), (41, np.inf), (42, -1.0)):
            pose = type(METRIC)(METRIC.rotation, METRIC.translation, True, 30, np.diag([wrong] * 6))
            recogniser.say(closure(query * S, 10 * S), pose)
        bridge.wait_for("relative pose of 40.000 has no finite, positive covariance; passed over")
        recogniser.say(closure(43 * S, 13 * S))
        wait_until(lambda: len(graphs) == 1, 60, "the edge with a covariance")
        for publisher in (recogniser.closures, recogniser.poses):
            listener.node.destroy_publisher(publisher)
        restarted = Recogniser(listener, "/hydra_bridge")
        restarted.say(closure(44 * S, 14 * S))
        wait_until(lambda: len(graphs) == 2, 60, "an edge of the recogniser that was restarted")
        assert bridge.end(signal.SIGTERM) == 0
    assert "Traceback" not in bridge.output
    assert "ended: 2 sent, 3 without a measured pose, 3 poses without a usable covariance" in bridge.output
    with running("hydra_bridge", READY) as bridge:  # gets the closures again that are kept for it, their poses not
        Recogniser(listener, "/hydra_bridge").say(closure(45 * S, 15 * S))
        wait_until(lambda: len(graphs) == 3, 60, "an edge of the bridge that was restarted")
        assert bridge.end() == 0
    assert [edge.key_from for graph in graphs for edge in graph.edges] == [43 * S, 44 * S, 45 * S]


def test_swarm_slam_gets_closures_between_its_keyframes(listener):
    """cslam/src/back_end/decentralized_pgo.cpp: BetweenFactor(keyframe0, keyframe1, transform) where success is set."""
    from cslam_common_interfaces.msg import IntraRobotLoopClosure, KeyframeOdom

    received = listener.collect(IntraRobotLoopClosure, "/cslam/intra_robot_loop_closure", 100)
    keyframes = listener.node.create_publisher(KeyframeOdom, "/cslam/keyframe_odom", 100)
    with running("swarm_slam_bridge", READY) as bridge:
        recogniser = Recogniser(listener, "/swarm_slam_bridge")
        wait_until(keyframes.get_subscription_count, 60, "the bridge")
        for i in range(50):
            keyframes.publish(KeyframeOdom(id=i, odom=odometry_message((1000 + 2 * i) * S, np.eye(4))))
        for i in range(30, 40):
            recogniser.say(closure((1000 + 2 * i) * S, (1000 + 2 * (i - 20)) * S))
        recogniser.say(closure(1080 * S, 1001 * S))  # between two keyframes, a second from both
        recogniser.say(closure(1200 * S, 1020 * S))  # its keyframe comes later
        wait_until(lambda: len(received) == 10, 60, "every closure")
        keyframes.publish(KeyframeOdom(id=50, odom=odometry_message(1200 * S, np.eye(4))))
        wait_until(lambda: len(received) == 11, 60, "the closure that waited")
        keyframes.publish(KeyframeOdom(id=3, odom=odometry_message(5 * S, np.eye(4))))
        bridge.wait_for("Swarm-SLAM was restarted")
        assert bridge.end() == 0
    factors = [(m.keyframe0_id, m.keyframe1_id) for m in received if m.success]
    assert factors == [*((i - 20, i) for i in range(30, 40)), (10, 50)]
    for message in received:
        np.testing.assert_allclose(matrix_of_transform(message.transform)[:3, 3], AHEAD, atol=1e-6)
    assert "ended: 11 sent, 0 without a measured pose" in bridge.output
    assert "1 without a keyframe" in bridge.output


def test_lio_sam_gets_the_last_pairs_once_it_listens(listener):
    """LIO-SAM, src/mapOptmization.cpp: two doubles, newer and older in seconds; a queue of the last five."""
    pairs = listener.node.create_publisher(Float64MultiArray, "/place_recognizer/lio_sam", TABLE_QOS)
    with running("lio_sam_bridge", "hands on /place_recognizer/lio_sam to /lio_loop/loop_closure_detection") as bridge:
        wait_until(pairs.get_subscription_count, 60, "the bridge")
        listener.met_by("/lio_sam_bridge")
        for i in range(7):
            pairs.publish(Float64MultiArray(data=[100.0 + i, float(i)]))
        bridge.wait_for("nobody listens on /lio_loop/loop_closure_detection; the last 5 closures are kept")
        for wrong in ([1.0], [5.0, 90.0], [float("nan"), 1.0]):
            pairs.publish(Float64MultiArray(data=wrong))
        bridge.wait_for("allowed: two stamps in seconds, the newer first")
        received = listener.collect(Float64MultiArray, "/lio_loop/loop_closure_detection", TABLE_QOS)
        wait_until(lambda: len(received) == 5, 60, "what was kept")
        pairs.publish(Float64MultiArray(data=[200.0, 50.0]))
        wait_until(lambda: len(received) == 6, 60, "a pair while LIO-SAM listens")
        assert bridge.end() == 0
    assert [list(m.data) for m in received] == [*([100.0 + i, float(i)] for i in range(2, 7)), [200.0, 50.0]]
    assert "ended: 6 sent, 2 without a listener, 3 malformed" in bridge.output


@pytest.mark.parametrize(
    ("bridge", "package"),
    [
        ("rtabmap_bridge", "rtabmap_msgs"),
        ("hydra_bridge", "pose_graph_tools_msgs"),
        ("swarm_slam_bridge", "cslam_common_interfaces"),
    ],
)
def test_a_missing_package_is_named(domain, bridge, package):
    code = f"import sys; sys.modules['{package}'] = None; from pnv_ros.bridges.{bridge} import main; sys.exit(main())"
    process = Process(sys.executable, "-c", code)
    assert process.wait() == 2
    assert f"no {package} on this machine; allowed: after apt-get install" in process.output
    assert "Traceback" not in process.output
