"""Parameter files, launch files and the interface page say what the code declares."""

import runpy
import sys
from types import ModuleType

import pytest
import yaml

from pnv_core.config import PRESETS
from pnv_core.settings import settings_of
from pnv_ros import reference
from pnv_ros.bridges.config import BRIDGE_SETTINGS
from pnv_ros.node_config import NodeConfig
from pnv_ros.parameters import DECLARED, NODE, RECOGNISER, descriptor_of, preset_defaults
from test.ros.processes import ROOT
from test.tally import tally

LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch.py"))


def test_config_files_and_interface_page_are_as_the_code_declares():
    for path, text in reference.files(ROOT).items():
        assert path.read_text() == text, f"{path} is stale: run python -m pnv_ros.reference"


@pytest.mark.parametrize("preset", PRESETS)
def test_a_parameter_file_holds_every_parameter_at_an_allowed_value(preset):
    text = (ROOT / "config" / f"{preset}.yaml").read_text()
    values = yaml.safe_load(text)["/**"]["ros__parameters"]
    for name, setting in DECLARED.items():
        assert f"{name}: " in text
        if name in values:
            assert setting.check(values[name]) == preset_defaults(preset)[name]


def test_settings_of_node_and_recogniser_have_different_names():
    assert not set(RECOGNISER) & set(NODE)
    assert settings_of(NodeConfig) == NODE


def test_every_parameter_is_described_with_its_range():
    for setting in DECLARED.values():
        descriptor = descriptor_of(setting)
        assert descriptor.description
        assert descriptor.additional_constraints
        numeric = setting.kind in (int, float) and not setting.many and setting.low is not None
        assert bool(descriptor.integer_range or descriptor.floating_point_range) == numeric


class _Call:
    """Remembers what a launch file constructs, and takes what launch 3.4.3 (Jazzy) takes."""

    SUBSTITUTIONS = ("LaunchConfiguration", "PathJoinSubstitution", "FindPackageShare")
    TEXTS = ("default_value", "namespace", "executable", "package", "name", "cmd")  # text or a flat list

    def __init__(self, name, log, *args, **kwargs):
        self.name, self.args, self.kwargs = name, args, kwargs
        log.append(self)
        if name in self.SUBSTITUTIONS:
            for part in args:
                _check_substitutions(part)
        for key in self.TEXTS:
            if key in kwargs:
                _check_substitutions(kwargs[key])
        if name == "Node":
            for pair in kwargs.get("remappings", ()):
                for side in pair:
                    _check_substitutions(side)
            if isinstance(kwargs["parameters"], str):
                raise TypeError(f"Expecting list of parameters, got {kwargs['parameters']}")
            for part in kwargs["parameters"]:
                if isinstance(part, dict):
                    for key, value in part.items():
                        _check_substitutions(key)
                        _check_parameter(value)
                else:
                    _check_substitutions(part)
        if name == "DeclareLaunchArgument" and not all(isinstance(t, str) for t in (*args, kwargs["description"])):
            raise TypeError("name and description are texts")


def _check_substitutions(given):
    """Text, a substitution, or a flat list of both, which launch 3.4.3 normalizes; a list in a list it refuses."""
    for part in given if isinstance(given, list | tuple) else [given]:
        if not isinstance(part, str) and getattr(part, "name", None) not in _Call.SUBSTITUTIONS:
            raise TypeError(f"Failed to normalize given item of type {type(part)!r}")


def _check_parameter(value):
    """Text, a number, a substitution, a ParameterValue, or a flat list: launch_ros' normalize_parameter_dict."""
    if getattr(value, "name", None) == "ParameterValue" or isinstance(value, str | int | float | bool):
        return
    if isinstance(value, list | tuple):
        for part in value:
            _check_substitutions([part] if not isinstance(part, int | float) else [])
    elif getattr(value, "name", None) not in _Call.SUBSTITUTIONS:
        raise TypeError(f"Unexpected type for parameter value {value!r}")


def test_the_stand_in_refuses_what_launch_3_4_3_refuses():
    """As ros2/launch 073c3ac normalize_to_list_of_substitutions_impl.py and 06dc66b declare_launch_argument.py, and
    ros2/launch_ros 076df87 normalize_parameters.py have it."""
    log = []
    preset = _Call("LaunchConfiguration", log, "preset")
    _Call("PathJoinSubstitution", log, ["config", preset])
    for wrong in ({"default_value": [preset, ["config"]]}, {"default_value": 1.0}, {"description": preset}):
        with pytest.raises(TypeError):
            _Call("DeclareLaunchArgument", log, "name", **{"description": "d"} | wrong)
    with pytest.raises(TypeError, match="normalize"):
        _Call("PathJoinSubstitution", log, ["config", [preset, ".yaml"]])
    node = {"package": "pnv_ros", "executable": "place_recognizer"}
    _Call("Node", log, **node, parameters=[[preset, ".yaml"], {"a": preset, "b": [1.0, 2.0], "c": "text", "d": True}])
    for wrong in (
        "file.yaml",
        [[["file.yaml"]]],
        [{"a": None}],
        [{"a": {1, 2}}],
        [{1: "a"}],
        [None],
        [{"a": [[preset]]}],
    ):
        with pytest.raises(TypeError):
            _Call("Node", log, **node, parameters=wrong)


def _stubs(log):
    """Stand-ins for the launch packages, which no wheel offers."""
    names = {
        "launch": ["LaunchDescription"],
        "launch.actions": [
            "DeclareLaunchArgument", "EmitEvent", "ExecuteProcess", "RegisterEventHandler", "TimerAction",
        ],
        "launch.event_handlers": ["OnProcessExit"],
        "launch.events": ["Shutdown"],
        "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.parameter_descriptions": ["ParameterValue"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }  # fmt: skip
    modules = {}
    for module, classes in names.items():
        modules[module] = ModuleType(module)
        for name in classes:
            make = lambda *args, _name=name, **kwargs: _Call(_name, log, *args, **kwargs)  # noqa: E731
            setattr(modules[module], name, make)
    return modules


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda p: p.name)
def test_launch_files_name_only_what_exists(path, monkeypatch):
    log: list[_Call] = []
    for name, module in _stubs(log).items():
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(path))["generate_launch_description"]()

    declared = {c.args[0]: c.kwargs for c in log if c.name == "DeclareLaunchArgument"}
    assert all(kwargs["description"] for kwargs in declared.values())
    assert {c.args[0] for c in log if c.name == "LaunchConfiguration"} == set(declared)
    nodes = [c for c in log if c.name == "Node"]
    bridges = {name: settings_of(kind) for name, kind in BRIDGE_SETTINGS.items()}
    executables = [node.kwargs["executable"] for node in nodes]
    assert executables in (["place_recognizer"], ["place_recognizer", "tf_bridge"], *([name] for name in bridges))
    for node in nodes:
        assert node.kwargs["package"] == "pnv_ros"
        settings = bridges.get(node.kwargs["executable"], DECLARED)
        given = {name for part in node.kwargs["parameters"] if isinstance(part, dict) for name in part}
        assert given - {"use_sim_time"} <= set(settings)
        for name in given & set(declared) & set(settings):
            if "default_value" in declared[name]:
                settings[name].check(yaml.safe_load(declared[name]["default_value"] or "''"))
    for files in (kwargs["default_value"] for name, kwargs in declared.items() if name == "params_file"):
        _, folder, argument, suffix = files
        assert argument.args == ("preset",)
        assert all((ROOT / (folder.strip("/")) / (preset + suffix)).is_file() for preset in PRESETS)
    tally("7 launch files, built as launch 3.4.3 checks them", 1, 1)


def test_there_is_a_launch_file_for_a_bag_for_two_cameras_and_for_every_bridge():
    assert [p.name for p in LAUNCH_FILES] == [
        "bag.launch.py", "hydra_bridge.launch.py", "lio_sam_bridge.launch.py", "place_recognizer.launch.py",
        "rtabmap_bridge.launch.py",
        "swarm_slam_bridge.launch.py", "tf_bridge.launch.py", "two_cameras.launch.py",
    ]  # fmt: skip
