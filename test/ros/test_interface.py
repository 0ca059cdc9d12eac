"""Topics, services and parameters of a node that gets no images."""

import re
import subprocess

import pytest
from rcl_interfaces.srv import DescribeParameters
from std_srvs.srv import SetBool

from msg_adapters.typed_closures import typed_type
from pnv_ros.parameters import DECLARED
from test.ros.camera import Health
from test.ros.controls import number, set_together, trigger
from test.ros.processes import NODE, ROOT, executable, running_node, wait_until

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def idle(domain):
    """A node that gets no images; whoever changes its settings puts them back."""
    with running_node(no_image_warning_s=0.5, acept_score=0.7) as node:
        yield node
        assert node.end() == 0
        assert "Traceback" not in node.output


def test_the_interface_page_names_every_topic_and_service_of_the_node(idle, listener):
    page = (ROOT / "docs" / "ros_interface.md").read_text()
    graph = listener.node
    wait_until(lambda: ("place_recognizer", "/") in graph.get_node_names_and_namespaces(), 60, "the node")
    own = {"/parameter_events", "/rosout", f"{NODE}/transition_event"}
    topics = dict(graph.get_publisher_names_and_types_by_node("place_recognizer", "/"))
    services = dict(graph.get_service_names_and_types_by_node("place_recognizer", "/"))
    named = {name: kinds for name, kinds in topics.items() if name not in own}
    named |= {n: k for n, k in services.items() if k[0].startswith("std_srvs")}
    assert len(named) == (12 if typed_type() is None else 13)
    for name, (kind,) in named.items():
        in_page = name.replace(NODE + "/", "~/").replace("/loop_closures", "loop_closures")
        assert re.search(rf"\| `{re.escape(in_page)}` \| {kind.replace('/msg/', '/').replace('/srv/', '/')} ", page)


def test_the_start_up_block_says_what_runs(idle):
    assert re.search(r"network      openvino, (float32|bfloat16), \d+ thread", idle.output)
    for words in ("model        default (",
                  "preset       default: ", "MB per keyframe",
                  "listens to   /camera/image_raw (Image, best effort, volatile)",
                  "publishes    /loop_closures"):  # fmt: skip
        assert words in idle.output


def test_a_topic_that_never_publishes_is_reported_with_its_qos(idle, listener):
    words = "on /camera/image_raw (Image, best effort, volatile): nobody publishes it"
    assert "no image for" in idle.wait_for(words)
    assert "nobody publishes it" in wait_until(
        lambda: (s := Health(listener).status).level == b"\x01" and s.message, 60, "a warning"
    )


def test_live_parameters_change_together_or_not_at_all(idle, listener):
    assert set_together(listener, accept_score=0.7, candidates=5).successful
    assert (number(listener, "accept_score"), number(listener, "candidates")) == (0.7, 5)
    refusal = set_together(listener, accept_score=0.2, candidates=0)
    assert not refusal.successful
    assert "candidates" in refusal.reason
    assert (number(listener, "accept_score"), number(listener, "candidates")) == (0.7, 5)
    wait_until(lambda: Health(listener).values()["accept_score"] == "0.700", 60, "the new threshold in use")
    assert set_together(listener, accept_score=0.5, candidates=10).successful


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"device": "cuda"}, "device needs a restart"),
        ({"accept_score": 2.0}, "accept_score"),
        ({"accept_score": float("nan")}, "accept_score"),
        ({"accept_score": "high"}, "'high' is out of range; allowed: number from 0 to 1"),
        ({"candidates": 3.5}, "allowed: whole number from 1 to 1000"),
        ({"candidates": True}, "allowed: whole number from 1 to 1000"),
        ({"exclude_recent_s": float("inf")}, "exclude_recent_s"),
        ({"exclude_recent_s": -1.0}, "exclude_recent_s"),
        ({"publish_markers": 1}, "allowed: true or false"),
    ],
)
def test_a_parameter_set_to_nonsense_is_refused_by_name(idle, listener, values, words):
    refusal = set_together(listener, **values)
    assert not refusal.successful
    assert words in refusal.reason
    assert "\n" not in refusal.reason


def test_parameters_describe_themselves(idle, listener):
    request = DescribeParameters.Request(names=["accept_score", "candidates", "device"])
    score, candidates, device = listener.call(DescribeParameters, f"{NODE}/describe_parameters", request).descriptors
    assert score.description == DECLARED["accept_score"].doc
    assert (score.floating_point_range[0].from_value, score.floating_point_range[0].to_value) == (0.0, 1.0)
    assert (candidates.integer_range[0].from_value, candidates.integer_range[0].to_value) == (1, 1000)
    assert device.additional_constraints == "one of cpu, cuda, auto; needs a restart"


def test_services_answer_with_what_they_did(idle, listener):
    answer = trigger(listener, "save")
    assert (answer.success, answer.message) == (False, "map_path is empty; allowed: a folder, set by the parameter "
                                                       "map_path")  # fmt: skip
    assert trigger(listener, "reset").message == "forgot 0 keyframes"
    pause = listener.call(SetBool, f"{NODE}/pause", SetBool.Request(data=True))
    assert pause.success
    wait_until(lambda: Health(listener).status.message == "paused", 60, "paused")
    assert listener.call(SetBool, f"{NODE}/pause", SetBool.Request(data=False)).message == "running"
    assert "images come" not in idle.output  # there is no camera


def test_an_unknown_parameter_is_named_with_the_nearest_known_one(idle):
    assert "no parameter acept_score; did you mean accept_score?" in idle.output
    assert idle.output.count("no parameter") == 1


def test_help_helps_instead_of_starting():
    told = subprocess.run([executable(), "--help"], capture_output=True, text=True, timeout=300)
    assert told.returncode == 0
    assert all(re.search(rf"^  {name} ", told.stdout, re.M) for name in DECLARED)
    told = subprocess.run([executable(), "accept_score:=0.7"], capture_output=True, text=True, timeout=300)
    assert told.returncode == 2
    assert told.stderr == (
        "place_recognizer: accept_score:=0.7; allowed: parameters, as --ros-args -p NAME:=VALUE (--help lists them)\n"
    )
