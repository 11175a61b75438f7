"""Replay a bag through the pipeline and score it; everything ends with the bag.

    ros2 launch lidar_perception replay.launch.py bag:=drive scores:=scores.json
"""

from pathlib import Path

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    IncludeLaunchDescription,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    TimerAction,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from lidar_perception.data.bag import Bag
from lidar_perception.nodes.graph import (
    chosen_clouds,
    evaluation,
    relative,
    result_topics,
    wait_for,
)
from lidar_perception.nodes.launching import (
    ARGUMENTS,
    given_arguments,
    parameter_files,
    refuse_unknown,
    with_arguments,
)
from lidar_perception.nodes.shared_memory import use_large_shared_memory
from lidar_perception.wire.clouds import CLOUD_TYPES
from lidar_perception.wire.topics import POINTS, TF_STATIC

VALUES = ("bag", "rate", "loop", "scores", "points", "config", "single", "real_time",
          "use_sim_time", "log_level")
HERE = Path(__file__).resolve().parent
CONFIG = HERE.parent / "config" / "replay.param.yaml"
GLOBAL = {TF_STATIC, "/tf", "/clock", "/diagnostics"}
SECONDS_FOR_THE_LAST_FRAME = 1.0
# What the player and the evaluator rely on. launch hands on to an included file whatever was given.
GRAPH = {"detectors": "candidates", "namespace": "", "name_prefix": ""}


def replay(context, given):
    refuse_unknown(given, context, {*VALUES, "rviz", *ARGUMENTS} - GRAPH.keys())
    value = {k: context.perform_substitution(LaunchConfiguration(k))
             for k in VALUES}
    single = value["single"] == "true"
    files = [str(CONFIG), *parameter_files(value["config"])]
    use_large_shared_memory()  # of the player, so that the nodes need not take it for a driver
    with Bag(value["bag"]) as bag:
        clouds = chosen_clouds(value["bag"], bag.topics, value["points"])
        played = [t for t, kind in bag.topics.items() if t == clouds or kind not in CLOUD_TYPES]
    sim_time = {"use_sim_time": value["use_sim_time"] == "true"}
    log_level = ["--log-level", value["log_level"]]
    remap, scoring = evaluation(value["scores"], single)
    final = relative(result_topics(single)["final"])
    real_time = value["real_time"] == "true"
    # launch knows no type of an empty list
    follow = {} if real_time else {"follow": [final]}
    waits = [*wait_for(single), f"{final}:={1 if real_time else 2}"]  # evaluator, player
    player = Node(
        package="lidar_perception", executable="bag_player", name="bag_player", output="screen",
        parameters=with_arguments(files, "bag_player", {
            "bag": value["bag"], "rate": float(value["rate"]), "loop": value["loop"] == "true",
            "topics": played, **follow, "wait_for": waits}),
        # Relative, so that they go into a namespace if this file is included in one.
        remappings=[(t, relative(POINTS if t == clouds else t)) for t in played
                    if t not in GLOBAL],
        ros_arguments=log_level)
    evaluator = Node(
        package="lidar_perception", executable="evaluator", name="evaluator", output="screen",
        parameters=with_arguments(files, "evaluator", {**scoring, **sim_time}),
        remappings=list(remap.items()), ros_arguments=log_level)
    end = TimerAction(period=SECONDS_FOR_THE_LAST_FRAME,
                      actions=[EmitEvent(event=Shutdown(reason="the bag is played"))])
    found = context.launch_configurations
    return [*(LogInfo(msg=f"{name}:={found[name]} is no argument of replay.launch.py")
              for name, fixed in GRAPH.items() if found.get(name, fixed) != fixed),
            player, evaluator,
            RegisterEventHandler(OnProcessExit(target_action=player, on_exit=[end]))]


def generate_launch_description():
    given = given_arguments()
    pipeline = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(HERE / "perception.launch.py")),
        launch_arguments={
            "points": relative(POINTS), **GRAPH,
            "config": [f"{CONFIG},", LaunchConfiguration("config")],
            **{k: LaunchConfiguration(k) for k in ("single", "rviz", "use_sim_time", "log_level")},
        }.items())
    return LaunchDescription([
        DeclareLaunchArgument("bag", description="Folder of the bag."),
        DeclareLaunchArgument("points", default_value="", description="The bag's topic of clouds; "
                              "empty: the only one it has."),
        DeclareLaunchArgument("rate", default_value="1.0", description="Speed of the replay."),
        DeclareLaunchArgument("loop", default_value="false", choices=["true", "false"],
                              description="Start again at the end."),
        DeclareLaunchArgument("scores", default_value="", description="JSON file for the scores."),
        DeclareLaunchArgument("config", default_value="", description="Parameter files, with "
                              "commas, on top of config/replay.param.yaml."),
        DeclareLaunchArgument("single", default_value="false", choices=["true", "false"],
                              description="All stages in one process."),
        DeclareLaunchArgument("rviz", default_value="false", choices=["true", "false"],
                              description="Start RViz with config/lidar_perception.rviz."),
        DeclareLaunchArgument("real_time", default_value="false", choices=["true", "false"],
                              description="Play as a sensor sends; false: a cloud is sent when "
                              "those before have their result."),
        DeclareLaunchArgument("use_sim_time", default_value="true", choices=["true", "false"],
                              description="Take the time from /clock."),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, ..."),
        # First, because the pipeline sets `points` and `config` to its own.
        OpaqueFunction(function=lambda context: replay(context, given)),
        pipeline,
    ])
