"""pnv_view: a page of its own beside a running node, over the real middleware."""

import json
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

from test.ros.processes import Process, publisher, running_node, wait_until
from test.ros.test_end_to_end import write_stamps

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.process


def fetched(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=60) as answer:
        return answer.read()


def test_the_page_shows_scores_health_and_the_match_of_a_running_node(domain, tmp_path):
    from pnv_lab.worlds import loop_sequence

    walk = loop_sequence(2, "hall", laps=1.0, fps=2.0, size=(160, 120))
    for i in range(6):
        cv2.imwrite(str(tmp_path / f"{i}.png"), walk[3 * (i % 3)].rgb[..., ::-1])
    stamps = [((1000 + 40 * i) * 10**9, tmp_path / f"{i}.png") for i in range(6)]
    table = write_stamps(tmp_path / "stamps.csv", stamps)
    watch = Process(sys.executable, "-m", "pnv_ros.watch", "--port", "0")
    try:
        url = watch.wait_for("http://127.0.0.1:").strip()
        assert b"<canvas" in fetched(url)
        with pytest.raises(urllib.error.HTTPError):
            fetched(f"{url}/etc/passwd")
        with running_node(min_change=0.0, **{"qos_overrides./camera/image_raw.subscription.reliability": "reliable"}):
            # the page hears the node before the first picture is sent: discovery takes seconds on a busy machine
            wait_until(lambda: "accept_score" in json.loads(fetched(f"{url}/state.json"))["values"], 60, "its health")
            assert publisher("--reliable", "--stamps", table, "--rate", "2", "--linger", "3").wait() == 0
            wait_until(lambda: len(json.loads(fetched(f"{url}/state.json"))["queries"]) >= 3, 60, "queries on the page")
            wait_until(lambda: len(json.loads(fetched(f"{url}/state.json"))["map"]["keyframes"]) >= 3, 60, "a map")
            state = json.loads(fetched(f"{url}/state.json"))
            picture = cv2.imdecode(np.frombuffer(fetched(f"{url}/match.jpg"), np.uint8), cv2.IMREAD_COLOR)
        assert picture.std() > 10
        for query, match, score, accepted in state["queries"]:
            assert query - match >= 30
            assert 0 <= score <= 1
            assert isinstance(accepted, bool)
        assert "accept_score" in state["values"]
        keyframes = np.array(state["map"]["keyframes"])  # on a time-line, 0.1 m a second, without odometry
        assert set(keyframes[:, 0].round(3)) <= {0.0, 4.0, 8.0, 12.0, 16.0, 20.0}
    finally:
        watch.child.terminate()
        watch.child.wait(30)


def test_a_port_that_is_taken_is_refused_in_one_line():
    command = [sys.executable, "-m", "pnv_ros.watch", "--bind", "203.0.113.1"]  # an address this machine has not
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert told.returncode == 2
    assert told.stderr.startswith("pnv_view: 203.0.113.1:8090: ")
