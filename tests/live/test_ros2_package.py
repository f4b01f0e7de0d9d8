"""The package for ROS 2, with a stand-in for rclpy: its files agree, and its node has the core of bin/live."""

import ast
import runpy
import signal
import sys
import time
import tomllib
import types
import xml.etree.ElementTree as xml
from pathlib import Path

import numpy as np
import pytest
import yaml

from sglpr_jax.cli.live import LiveCommand
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.ros_encoding import CLOUD, EDGE, TRANSFORMS
from sglpr_jax.live.ros_topics import SCAN_QUEUE, RosSink, RosSource, Transport
from tests.live.messages import ODOMETRY, POINTS, cloud, odometry, received
from tests.live.test_ros_topics import Memory

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "ros2" / "sglpr_ros"


class Standing:
    """A node of rclpy that keeps what was asked of it."""

    def __init__(self):
        self.subscribed, self.advertised, self.sent, self.destroyed = {}, [], [], []

    def create_subscription(self, of, topic, take, qos, *, raw):
        assert raw
        self.subscribed[topic, of] = take, qos
        return topic

    def create_publisher(self, of, topic, qos):
        self.advertised.append((topic, of))
        return types.SimpleNamespace(publish=lambda cdr: self.sent.append((topic, of, cdr)))

    def destroy_subscription(self, one):
        self.destroyed.append(one)

    destroy_publisher = destroy_subscription

    def get_topic_names_and_types(self):
        return [("/points", [CLOUD]), ("/nobody", ["std_msgs/msg/String"])]

    def count_publishers(self, topic):
        return topic == "/points"

    def declare_parameter(self, name, value, descriptor):
        assert descriptor.dynamic_typing
        return types.SimpleNamespace(value=value)

    def get_logger(self):
        return types.SimpleNamespace(info=str, warning=str)


@pytest.fixture
def package(monkeypatch):
    """The modules of the package, with a stand-in for those of ROS 2."""
    policies = {
        name: types.SimpleNamespace(
            KEEP_LAST="last", RELIABLE="sure", BEST_EFFORT="best", TRANSIENT_LOCAL=1, VOLATILE=0
        )
        for name in ("DurabilityPolicy", "HistoryPolicy", "ReliabilityPolicy")
    }

    running = []

    def get_message(kind: str) -> str:
        if kind.startswith("livox"):
            raise ModuleNotFoundError(kind)
        return kind

    for name, members in {
        "rclpy": {
            "init": lambda *, signal_handler_options: running.append(signal_handler_options),
            "create_node": lambda name: Standing(),
            "spin": lambda node: None,
            "ok": lambda: bool(running),
            "try_shutdown": running.clear,
        },
        "rcl_interfaces": {},
        "rcl_interfaces.msg": {"ParameterDescriptor": types.SimpleNamespace},
        "rclpy.qos": {"QoSProfile": dict, **policies},
        "rclpy.signals": {"SignalHandlerOptions": types.SimpleNamespace(NO="none")},
        "rclpy.executors": {"ExternalShutdownException": RuntimeError},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": get_message},
    }.items():
        module = types.ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(PACKAGE))
    from sglpr_ros import node, parameters, transport  # pyright: ignore

    yield types.SimpleNamespace(node=node, parameters=parameters, transport=transport)
    for name in [name for name in sys.modules if name.split(".")[0] == "sglpr_ros"]:
        del sys.modules[name]


def setup_arguments() -> dict:
    """Arguments of `setup` in setup.py."""
    calls = [one for one in ast.walk(ast.parse((PACKAGE / "setup.py").read_text())) if isinstance(one, ast.Call)]
    return {one.arg: ast.literal_eval(one.value) for one in calls[0].keywords if one.arg is not None}


def test_the_metadata_agree(package):
    described, built = xml.parse(PACKAGE / "package.xml").getroot(), setup_arguments()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for name in ("name", "version", "description", "license"):
        assert described.findtext(name) == built[name]
    assert (built["version"], built["license"]) == (project["version"], project["license"])
    files = dict(built["data_files"])
    assert files["share/ament_index/resource_index/packages"] == [f"resource/{built['name']}"]
    assert all((PACKAGE / path).is_file() for paths in files.values() for path in paths)
    (script,) = built["entry_points"]["console_scripts"]
    assert script == "sglpr = sglpr_ros.node:main" and callable(package.node.main)


def test_the_packages_of_all_messages_are_dependencies(package, said):
    node = Standing()
    transport = package.transport.RclpyTransport(node, said)
    RosSource(transport, LiveOptions(odometry_topic="odom"), said)
    RosSink(transport, LiveOptions())
    kinds = {kind for _, kind in [*node.subscribed, *node.advertised]}
    assert {CLOUD, EDGE, TRANSFORMS} <= kinds
    parts_of_each = {"std_msgs", "builtin_interfaces"}  # header and stamp
    depends = {depend.text for depend in xml.parse(PACKAGE / "package.xml").getroot().iter("exec_depend")}
    assert {kind.split("/")[0] for kind in kinds} | parts_of_each <= depends


def test_the_launch_file_starts_the_node_with_the_usual_parameters(monkeypatch):
    """With a stand-in for the packages of launch: each call is kept as (name, positional arguments, options)."""

    def keeping(name):
        return lambda *words, **options: (name, words, options)

    for module, names in {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument"],
        "launch.substitutions": ["LaunchConfiguration"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "ament_index_python": [],
    }.items():
        made = types.ModuleType(module)
        vars(made).update({name: keeping(name) for name in names})
        monkeypatch.setitem(sys.modules, module, made)
    packages = types.ModuleType("ament_index_python.packages")
    vars(packages)["get_package_share_directory"] = lambda name: str(PACKAGE) if name == PACKAGE.name else ""
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", packages)
    launched = runpy.run_path(str(PACKAGE / "launch" / "sglpr.launch.py"))["generate_launch_description"]()
    (argument, node) = launched[1][0]
    assert argument[1] == ("parameters",) and Path(argument[2]["default_value"]).is_file()
    (script,) = setup_arguments()["entry_points"]["console_scripts"]
    assert node[2]["package"] == PACKAGE.name and script.startswith(f"{node[2]['executable']} = ")
    assert node[2]["parameters"] == [("LaunchConfiguration", ("parameters",), {})]


def test_parameters_are_flags_of_bin_live(package):
    defaults, command_of = package.parameters.defaults(), package.parameters.command_of
    out = Path(package.parameters.OUT)
    assert command_of(defaults) == LiveCommand(source="ros2", sinks=("ros2",), out=out)
    assert command_of({**defaults, "sensor_height": "1.7", "max_places": 9}).decision.max_places == 9
    with pytest.raises(ValueError, match="sensor_height: expected metres or auto, found high"):
        command_of({**defaults, "sensor_height": "high"})
    written = yaml.safe_load((PACKAGE / "config" / "sglpr.yaml").read_text())["sglpr"]["ros__parameters"]
    assert set(written) <= set(defaults) and all(type(defaults[name]) is type(written[name]) for name in written)
    given = command_of({**defaults, **written})
    assert given == LiveCommand(source="ros2", sinks=("ros2",), out=out, topic="/points", odometry_topic="/odom")


def test_messages_stay_encoded(package, said):
    node = Standing()
    wire = package.transport.RclpyTransport(node, said)
    assert isinstance(wire, Transport)
    source = RosSource(wire, LiveOptions(odometry_topic="odom"), said)
    assert not any("livox" in kind for _, kind in node.subscribed)
    for seconds in (12.4, 12.6):
        node.subscribed["/odom", ODOMETRY][0](odometry(seconds, (seconds, 0, 0), child="lidar"))
    take, qos = node.subscribed["/points", CLOUD]
    take(cloud(12.5))
    assert (qos["depth"], qos["reliability"], qos["durability"]) == (SCAN_QUEUE, "best", 0)
    assert node.subscribed["/tf_static", TRANSFORMS][1]["durability"] == 1
    frame = next(source.frames())
    np.testing.assert_array_equal(frame.scan.points, POINTS)
    np.testing.assert_allclose(frame.odometry[:3, 3], [12.5, 0, 0])
    wire.advertise("/sglpr/loops", EDGE, depth=5, latched=True)(b"cdr")
    assert node.sent == [("/sglpr/loops", EDGE, b"cdr")]
    assert wire.published() == {"/points": {CLOUD}}
    node.subscribed["/odom", ODOMETRY][0](b"short")
    assert [kind for kind, _ in said] == ["message /odom"]
    wire.close()
    assert len(node.destroyed) == len(node.subscribed) + 1


@pytest.mark.slow
def test_the_node_runs_until_ros_ends(package, said, tmp_path, monkeypatch):
    monkeypatch.setattr("sglpr_jax.live.node.warm_up", lambda *_, **__: None)
    wire, begun, lines = Memory(), time.monotonic(), []

    def should_stop() -> bool:
        sent = len(wire.sent)
        if sent < 2:
            for seconds in (12.4 + sent, 12.6 + sent):
                wire.receive["/odom"](received(ODOMETRY, odometry(seconds, (seconds, 0, 0), child="lidar")))
            wire.receive["/points"](received(CLOUD, cloud(12.5 + sent, np.tile(POINTS, (9, 1)))))
        assert time.monotonic() - begun < 60
        return sent == 2

    given = {"out": str(tmp_path / "map"), "weights": "sglpr-small", "odometry_topic": "/odom"}
    values = {**package.parameters.defaults(), **given}
    command = package.parameters.command_of(values)
    package.node.run(command, lambda: wire, said, say=lines.append, should_stop=should_stop)
    assert [topic for topic, *_ in wire.sent] == ["/tf", "/tf"]
    assert lines[-2].startswith("2 scans") and (tmp_path / "map" / "frames.log").is_file()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_while_ros_is_running(package, monkeypatch, number):
    ended = []

    def run(*_, should_stop, **__):
        assert not should_stop()
        signal.raise_signal(number)
        assert should_stop() and sys.modules["rclpy"].ok()
        ended.append(number)

    monkeypatch.setattr(package.node, "run", run)
    package.node.main()
    assert ended == [number] and not sys.modules["rclpy"].ok()
