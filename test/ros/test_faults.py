"""What goes wrong on a robot, over real processes and the real middleware.

PNV_ROS_FAULTS=full runs the full counts: 10,000 malformed messages, five minutes at 60 Hz.
"""

import csv
import os
import resource
import signal
import sys
import threading
import time
from array import array
from contextlib import closing

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Float64MultiArray

from pnv_ros.outputs import CLOSURES_QOS
from pnv_ros.parameters import DECLARED
from test.ros.camera import EPOCH_S, Camera, Health, dealt_with, image, reliable, scene
from test.ros.controls import trigger
from test.ros.malform import png_claiming
from test.ros.processes import NODE, ROOT, Listener, Process, publisher, running_node, wait_until
from test.tally import tally

pytestmark = pytest.mark.process
FULL = os.environ.get("PNV_ROS_FAULTS") == "full"
EAGER = {"min_interval_s": 0.0, "min_change": 0.0, "consistency": 0} | reliable("camera/image_raw", "front", "rear")
STILL = {"min_interval_s": 0.0, "min_change": 2.0}  # one keyframe, so that memory has no reason to grow
MOST_THREADS = 40  # the middleware's and torch's own, counted once at rest: about 25


def at(seconds):
    return (EPOCH_S + seconds) * 10**9


def noise_stamps(path, count, step_ns):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows((at(0) + i * step_ns, "") for i in range(count))
    return str(path)


def test_malformed_messages_cost_neither_the_node_nor_a_good_frame(listener, capsys):
    count = 10_000 if FULL else 150
    topics = ["raw", "packed/compressed"]
    delivery = {f"qos_overrides./{t}.subscription.{k}": v for t in topics for k, v in (("reliability", "reliable"),
                                                                                      ("depth", 1000))}  # fmt: skip
    with running_node(image_topics=topics, **STILL, **delivery) as node:
        health = Health(listener)
        offered = good = 0
        for begin in (EPOCH_S, EPOCH_S + 100_000):  # queues and buffers fill in the first half
            memory = node.memory_mb()
            camera = Process(sys.executable, "-m", "test.ros.malform", "--count", str(count), "--begin", str(begin),
                             "--good-every", str(max(50, count // 50)))  # fmt: skip
            line = camera.wait_for("offered", 1200)
            assert camera.wait() == 0
            offered, good = offered + int(line.split()[1]), good + int(line.split()[-2])
        values = health.fresh() and health.values()
        survived = dealt_with(values)
        with capsys.disabled():
            print(f"\nmalformed: offered {offered} + {good} good, dealt with {survived}, in the second half "
                  f"memory {memory:.0f} -> {node.memory_mb():.0f} MB, {node.threads()} threads")  # fmt: skip
        tally("12 malformed messages", offered + good, survived, offered + good - survived)
        assert survived == offered + good
        assert int(values["frames processed"]) >= good
        assert int(values["dropped: unusable"]) > offered // 3
        assert node.memory_mb() < memory + 60
        assert node.threads() <= MOST_THREADS
        assert len(node.lines) < 40 + 2 * (time.monotonic() - node.started)  # warnings are throttled
        assert node.end() == 0
        assert "Traceback" not in node.output


def test_a_decompression_bomb_is_refused_before_it_is_unpacked(listener):
    health = Health(listener)
    with running_node(transport="compressed", **STILL) as node:
        camera = Camera(listener, health, "camera/image_raw", CompressedImage)
        before = node.memory_mb()
        for second, (width, height) in enumerate([(60_000, 60_000), (2**31 - 1, 2**31 - 1), (40_000, 40_000)]):
            bomb = CompressedImage(format="png", data=array("B", png_claiming(width, height)))
            bomb.header.stamp.sec = EPOCH_S + second
            camera.send(bomb)
        assert health.count("dropped: unusable") == 3
        assert node.memory_mb() < before + 20
        assert "3600000000 pixels; allowed: up to 67 megapixels" in node.output
        assert node.end() == 0


def test_full_speed_full_hd_leaves_memory_flat(listener, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(ROOT / "config" / "fastdds_shared_memory.xml"))
    seconds = 300 if FULL else 8
    table = noise_stamps(tmp_path / "stamps.csv", 60 * seconds, 10**9 // 60)
    with running_node(**STILL) as node:
        health = Health(listener)
        camera = publisher("--stamps", table, "--rate", "60", "--size", "1920x1080", "--same")
        samples = []
        while camera.child.poll() is None:
            time.sleep(0.5)
            samples.append((node.memory_mb(), node.threads()))
        assert camera.wait() == 0
        health.fresh()
        wait_until(lambda: (v := health.values()) and int(v["frames in"]) == dealt_with(v), 60, "the last frame")
        values = health.values()
        settled, last = samples[len(samples) // 2][0], samples[-1][0]
        with capsys.disabled():
            print(f"\n{60 * seconds} frames of 1920x1080: in {values['frames in']}, processed "
                  f"{values['frames processed']}, busy {values['dropped: busy']}, memory half way {settled:.0f}, "
                  f"at the end {last:.0f} MB, threads at most {max(t for _, t in samples)}")  # fmt: skip
        assert last < settled + 30
        assert max(t for _, t in samples) <= MOST_THREADS
        assert int(values["frames in"]) == dealt_with(values) > 10
        assert node.end() == 0


def test_a_publisher_that_dies_and_comes_back_is_heard_again(listener, tmp_path):
    first = noise_stamps(tmp_path / "first.csv", 600, 10**8)
    with running_node(no_image_warning_s=1.0, **STILL) as node:
        health = Health(listener)
        camera = publisher("--stamps", first)
        wait_until(lambda: health.count("frames processed") > 2, 60, "frames")
        camera.end(signal.SIGKILL)
        silent, back = (node.output.count(words) for words in ("no image for", "images come on camera/image_raw"))
        wait_until(lambda: node.output.count("no image for") > silent, 60, "a word of silence")
        before = health.count("frames processed")
        second = tmp_path / "second.csv"
        second.write_text("".join(f"{at(1000 + i)},\n" for i in range(100)))
        camera = publisher("--stamps", str(second))
        wait_until(lambda: node.output.count("images come on camera/image_raw") > back, 60, "a word of images")
        wait_until(lambda: health.count("frames processed") > before, 60, "frames again")
        camera.end(signal.SIGKILL)
        assert node.end() == 0


def test_a_clock_that_jumps_is_survived_reset_starts_time_anew_and_sizes_may_change(listener):
    health = Health(listener)
    with running_node(**EAGER) as node:
        camera = Camera(listener, health, "camera/image_raw")
        for seconds in (0, 10**8, 1):  # forward by three years, and back
            camera.send(image(scene(seconds), at(seconds)))
        node.wait_for("stamps of camera/image_raw went back by 99999999.000 s")
        health.fresh()
        assert "have stamps before the last one and are skipped" in health.status.message
        assert trigger(listener, "reset").message == "forgot 2 keyframes"
        camera.send(image(scene(1), at(2)))
        assert health.count("keyframes") == 1
        camera.send(image(scene(2, 160, 120), at(4)))  # another camera on the same topic
        node.wait_for("images of camera/image_raw changed from 320x240 to 160x120")
        assert health.count("keyframes") == 2
        assert node.end() == 0


def test_a_full_disk_while_saving_is_told_and_frames_go_on(listener, tmp_path):
    health, limit = Health(listener), 60_000
    with running_node(map_path=tmp_path / "map", autosave=True, autosave_interval_s=2.0, **EAGER) as node:
        camera = Camera(listener, health, "camera/image_raw")
        camera.send(image(scene(1), at(1)))
        camera.send(image(scene(2), at(2)))
        resource.prlimit(node.child.pid, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        camera.send(image(scene(3), at(3)))
        answer = trigger(listener, "save")
        assert not answer.success
        assert "cannot save" in answer.message
        wait_until(lambda: health.status.level == b"\x02", 60, "an error on /diagnostics")
        assert health.status.message.startswith("autosave: cannot save")
        resource.prlimit(node.child.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        assert trigger(listener, "save").message.startswith(f"saved {tmp_path / 'map'}: 3 keyframes")
        wait_until(lambda: health.status.level == b"\x00", 60, "diagnostics without an error")
        assert node.end() == 0


def test_a_node_whose_last_autosave_fails_ends_with_a_status_that_says_so(listener, tmp_path):
    health = Health(listener)
    with running_node(map_path=tmp_path / "map", autosave=True, autosave_interval_s=600.0, **EAGER) as node:
        Camera(listener, health, "camera/image_raw").send(image(scene(1), at(1)))
        resource.prlimit(node.child.pid, resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
        assert node.end() == 1
    assert "autosave: cannot save" in node.output
    assert "Traceback" not in node.output
    tally("1b autosaves that fail to the end and are said by the exit status", 1, 1)


def test_a_subscriber_that_never_reads_does_not_hold_the_node_up(listener, tmp_path):
    count, wake = 300 if FULL else 40, threading.Event()
    sleeper = Listener()
    sleeper.node.create_subscription(Float64MultiArray, "/loop_closures", lambda _: wake.wait(), CLOSURES_QOS)
    with running_node(accept_score=0.0, exclude_recent_s=1.0, verify=0, **EAGER) as node:
        health = Health(listener)
        camera = publisher(
            "--stamps", noise_stamps(tmp_path / "stamps.csv", count, 10**9), "--rate", "10", "--reliable"
        )
        assert camera.wait() == 0
        wait_until(lambda: health.count("frames processed") > count // 10, 60, "frames in spite of the sleeper")
        wait_until(lambda: health.count("closures") > 0, 60, "a closure")
        assert node.end() == 0
    wake.set()
    sleeper.close()


def test_random_parameters_leave_the_node_valid(listener):
    values = st.one_of(
        st.booleans().map(lambda v: ParameterValue(type=1, bool_value=v)),
        st.integers(-(2**63), 2**63 - 1).map(lambda v: ParameterValue(type=2, integer_value=v)),
        st.floats(width=64).map(lambda v: ParameterValue(type=3, double_value=v)),
        st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=20).map(
            lambda v: ParameterValue(type=4, string_value=v)
        ),
        st.lists(st.integers(-5, 5), max_size=4).map(lambda v: ParameterValue(type=7, integer_array_value=v)),
        st.just(ParameterValue()),
    )
    results = []
    with running_node(**EAGER) as node:
        health = Health(listener)
        camera = Camera(listener, health, "camera/image_raw")

        @settings(max_examples=1000 if FULL else 100, deadline=None, database=None, phases=[Phase.generate],
                  suppress_health_check=list(HealthCheck))  # fmt: skip
        @given(st.sampled_from(sorted(DECLARED)), values)
        def set_nonsense(name, value):
            request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
            results.append(listener.call(SetParameters, f"{NODE}/set_parameters", request).results[0])

        set_nonsense()
        refused = [r for r in results if not r.successful]
        assert len(refused) > len(results) // 2
        assert all(r.reason and "\n" not in r.reason for r in refused)
        camera.send(image(scene(1), at(1)))
        assert health.count("frames processed") == 1
        tally("6 parameters set to anything while running", len(results), len(results))
        assert node.end() == 0


def test_a_node_killed_in_the_middle_of_saving_starts_again_with_its_map(domain, tmp_path):
    rounds = 10 if FULL else 2
    keep = {"map_path": tmp_path / "map", "load_on_start": True, "autosave": True, "autosave_interval_s": 1.0} | EAGER
    known = 0
    for turn in range(rounds):
        with running_node(**keep) as node:
            if known:
                node.wait_for(f"loaded {known} keyframes")
            with closing(Listener()) as fresh:  # it takes no node that was killed for this one
                Camera(fresh, Health(fresh), "camera/image_raw").send(image(scene(turn), at(turn)))
            node.wait_for(f"{known + 1} keyframes, 1 new")
            known += 1
            node.child.send_signal(signal.SIGKILL)
            node.wait()
