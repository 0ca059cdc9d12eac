"""The services of pnv_msgs, asked of the node in a process of its own."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from msg_adapters.typed_closures import typed_type

if typed_type() is None:
    pytest.skip("pnv_msgs is not built", allow_module_level=True)

from pnv_msgs.srv import GetKeyframe, LoadMap, QueryImage, SaveMap

from test.ros.camera import Camera, Health, image, scene
from test.ros.processes import NODE, running_node
from test.ros.test_faults import EAGER, at

pytestmark = pytest.mark.process


def test_maps_go_to_paths_an_image_finds_its_place_and_a_keyframe_can_be_had(listener, tmp_path):
    def ask(kind, name, **request):
        return listener.call(kind, f"{NODE}/{name}", kind.Request(**request))

    with running_node(map_path=tmp_path / "own", **EAGER) as node:
        camera = Camera(listener, Health(listener), "camera/image_raw")
        for place in range(4):
            camera.send(image(scene(place), at(place)))
        for path in ("other", "own"):
            done = ask(SaveMap, "save_map", path=str(tmp_path / path) if path == "other" else "")
            assert done.success, done.message
            assert f"{tmp_path / path}: 4 keyframes" in done.message

        found = ask(QueryImage, "query_image", image=image(scene(2), at(50)))
        assert found.success, found.message
        best = found.candidates.closures[0]
        assert (best.match.id, best.match.camera, best.accepted) == (2, "camera/image_raw", True)
        assert best.query.id == best.query.NO_KEYFRAME
        elsewhere = ask(QueryImage, "query_image", image=image(scene(77), at(51)))
        assert not any(c.accepted for c in elsewhere.candidates.closures)
        refused = ask(QueryImage, "query_image", image=image(scene(2), at(52)), camera="rear")
        assert (refused.success, refused.message[:22]) == (False, "camera 'rear' given; a")
        broken = image(scene(2), at(53))
        broken.encoding = "no such"
        assert "no such" in ask(QueryImage, "query_image", image=broken).message
        assert Health(listener).count("keyframes") == 4  # no query was added

        keyframe = ask(GetKeyframe, "get_keyframe", id=2).keyframe
        assert keyframe.image.stamp.sec == at(2) // 10**9
        assert np.linalg.norm(keyframe.descriptor) == pytest.approx(1, abs=1e-3)
        shown = cv2.imdecode(np.frombuffer(bytes(keyframe.thumbnail), np.uint8), cv2.IMREAD_UNCHANGED)
        seen = cv2.resize(cv2.cvtColor(scene(2), cv2.COLOR_RGB2GRAY), shown.shape[::-1], interpolation=cv2.INTER_AREA)
        assert shown.ndim == 2  # a small grey JPEG of that place, and of no other
        assert bytes(keyframe.thumbnail[:2]) == b"\xff\xd8"
        assert np.corrcoef(shown.ravel(), seen.ravel())[0, 1] > 0.9
        assert "keyframe 99 is not in the map" in ask(GetKeyframe, "get_keyframe", id=99).message

        assert str(tmp_path / "no") in ask(LoadMap, "load_map", path=str(tmp_path / "no")).message
        done = ask(LoadMap, "load_map", path=str(tmp_path / "other"))
        assert done.success, done.message
        assert f"loaded 4 keyframes from {tmp_path / 'other'}" in done.message
        assert node.end() == 0
        assert "Traceback" not in node.output


def test_a_keyframe_of_a_node_that_verifies_nothing_has_no_picture(listener):
    with running_node(verify=0, **EAGER) as node:
        Camera(listener, Health(listener), "camera/image_raw").send(image(scene(0), at(0)))
        answer = listener.call(GetKeyframe, f"{NODE}/get_keyframe", GetKeyframe.Request(id=0))
        assert (answer.success, len(answer.keyframe.thumbnail)) == (True, 0)
        assert node.end() == 0


@pytest.mark.parametrize("found", ["None", "types.ModuleType('pnv_msgs')"], ids=["nothing", "the sources' folder"])
def test_without_pnv_msgs_the_node_has_the_other_services(listener, found):
    code = (
        f"import sys, types; found = {found}\n"
        "sys.modules |= dict.fromkeys(('pnv_msgs', 'pnv_msgs.msg', 'pnv_msgs.srv'), found)\n"
        "import rclpy; rclpy.init()\n"
        "from pnv_ros.node import PlaceRecognizerNode; node = PlaceRecognizerNode(print)\n"
        "names = {n for n, _ in node.get_service_names_and_types_by_node('place_recognizer', '/')}\n"
        "assert '/place_recognizer/save' in names and '/place_recognizer/save_map' not in names, names"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=300).returncode == 0
