"""Two real nodes with a served store between them."""

import pytest
from std_msgs.msg import Float64MultiArray

from msg_adapters.loop_closures import closures_from_message
from pnv_ros.outputs import CLOSURES_QOS
from test.ros.camera import EPOCH_S, Camera, Health, image, reliable, scene
from test.ros.processes import Listener, own_domain, running_node, wait_until

SECOND = 10**9
SETTINGS = {"min_interval_s": 0.0, "min_change": 0.0, "consistency": 0}


@pytest.mark.process
def test_one_node_recognises_where_another_was(server, tmp_path):
    with own_domain():
        listener = Listener()
        heard = listener.collect(Float64MultiArray, "/beta/loop_closures", CLOSURES_QOS)
        fleet = {"fleet_uri": server.uri, "fleet_outbox": tmp_path, "fleet_budget_ms": 10_000.0}
        try:
            for robot, start_s, scenes in (("alpha", 0, (1, 2, 3, 4)), ("beta", 500, (50, 3))):
                topic = f"/{robot}/camera/image_raw"
                settings = SETTINGS | fleet | reliable(topic.lstrip("/"))
                with running_node("-r", f"__ns:=/{robot}", **settings):
                    health = Health(listener, f"/{robot}/place_recognizer")
                    camera = Camera(listener, health, topic)
                    for second, number in enumerate(scenes):
                        camera.send(image(scene(number), (EPOCH_S + start_s + second) * SECOND))
                    sent = len(scenes)
                    wait_until(lambda h=health, n=sent: h.count("fleet: keyframes sent") == n, 60, "the store")
            wait_until(lambda: heard, 60, "a closure")
        finally:
            listener.close()
    (closure,) = closures_from_message(heard[0])
    assert (closure.query.robot, closure.match.robot) == ("beta", "alpha")
    assert (closure.query.stamp_ns, closure.match.stamp_ns) == ((EPOCH_S + 501) * SECOND, (EPOCH_S + 2) * SECOND)
    assert len(heard) == 1
