"""Launch a replay of a bag through one or several detectors, and score them; it ends with the bag.

    ros2 launch lidar_perception replay.launch.py bag:=drive scores:=scores.json
    ros2 launch lidar_perception replay.launch.py bag:=drive detectors:=fused,pointpillars

The arguments of detectors.launch.py are valid, too, except namespace and name_prefix.
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
    FINAL,
    choose_cloud_topic,
    configure_evaluator,
    list_awaited_topics,
    list_result_topics,
    relative_name,
)
from lidar_perception.nodes.launch_parameters import add_arguments, list_parameter_files, split_detectors
from lidar_perception.nodes.launching import ARGUMENTS, find_given_arguments, reject_unknown_arguments
from lidar_perception.nodes.shared_memory import use_large_shared_memory
from lidar_perception.wire.clouds import CLOUD_TYPES
from lidar_perception.wire.topics import POINTS, TF_STATIC

VALUES = (
    "bag",
    "detectors",
    "rate",
    "loop",
    "scores",
    "points",
    "config",
    "single",
    "real_time",
    "use_sim_time",
    "log_level",
)
HERE = Path(__file__).resolve().parent
CONFIG = HERE.parent / "config" / "replay.param.yaml"
# The protocol of the STM-CPA paper, for the candidates.
PAPER_CONFIG = HERE.parent / "config" / "replay_candidates.param.yaml"
GLOBAL = {TF_STATIC, "/tf", "/clock", "/diagnostics"}
LAST_FRAME_DELAY_S = 1.0
# Fixed, as the player and the evaluator rely on it; launch passes all given arguments on to an
# included file.
GRAPH = {"namespace": "", "name_prefix": ""}


def replay(context, given):
    reject_unknown_arguments(given, context, {*VALUES, "rviz", *ARGUMENTS} - GRAPH.keys())
    value = {k: context.perform_substitution(LaunchConfiguration(k)) for k in VALUES}
    single, detectors = value["single"] == "true", split_detectors(value["detectors"])
    own = [str(CONFIG), *([str(PAPER_CONFIG)] if "candidates" in detectors else [])]
    files = [*own, *list_parameter_files(value["config"])]
    use_large_shared_memory()  # set here, so that the nodes do not take the player for a driver
    with Bag(value["bag"]) as bag:
        clouds = choose_cloud_topic(value["bag"], bag.topics, value["points"])
        played = [t for t, kind in bag.topics.items() if t == clouds or kind not in CLOUD_TYPES]
    sim_time = {"use_sim_time": value["use_sim_time"] == "true"}
    log_level = ["--log-level", value["log_level"]]
    remap, scoring = configure_evaluator(value["scores"], single, detectors)
    finals = [relative_name(list_result_topics(single, name)[FINAL]) for name in detectors]
    real_time = value["real_time"] == "true"
    # launch cannot determine the type of an empty list.
    follow = {} if real_time else {"follow": finals}
    clouds_for = len(detectors) if single else 1  # subscribers of the clouds
    waits = [
        *list_awaited_topics(detectors, single, clouds_for),
        *(f"{final}:={1 if real_time else 2}" for final in finals),
    ]  # evaluator, player
    player = Node(
        package="lidar_perception",
        executable="bag_player",
        name="bag_player",
        output="screen",
        parameters=add_arguments(
            files,
            "bag_player",
            {
                "bag": value["bag"],
                "rate": float(value["rate"]),
                "loop": value["loop"] == "true",
                "topics": played,
                **follow,
                "wait_for": waits,
            },
        ),
        # Relative, so that they go into a namespace if this file is included in one.
        remappings=[(t, relative_name(POINTS if t == clouds else t)) for t in played if t not in GLOBAL],
        ros_arguments=log_level,
    )
    evaluator = Node(
        package="lidar_perception",
        executable="evaluator",
        name="evaluator",
        output="screen",
        parameters=add_arguments(files, "evaluator", {**scoring, **sim_time}),
        remappings=list(remap.items()),
        ros_arguments=log_level,
    )
    end = TimerAction(period=LAST_FRAME_DELAY_S, actions=[EmitEvent(event=Shutdown(reason="the bag is played"))])
    graph = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(HERE / "detectors.launch.py")),
        launch_arguments={
            "points": relative_name(POINTS),
            **GRAPH,
            "config": ",".join(files),
            "detectors": value["detectors"],
            **{k: LaunchConfiguration(k) for k in ("single", "rviz", "use_sim_time", "log_level")},
        }.items(),
    )
    configurations = context.launch_configurations
    return [
        *(
            LogInfo(msg=f"{name}:={configurations[name]} is not an argument of replay.launch.py")
            for name, fixed in GRAPH.items()
            if configurations.get(name, fixed) != fixed
        ),
        player,
        evaluator,
        RegisterEventHandler(OnProcessExit(target_action=player, on_exit=[end])),
        graph,
    ]


def generate_launch_description():
    given = find_given_arguments()
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="Folder of the bag."),
            DeclareLaunchArgument(
                "detectors",
                default_value="candidates",
                description="Comma-separated detectors to replay and to score: "
                "candidates, pointpillars, pointnet, fused.",
            ),
            DeclareLaunchArgument(
                "points", default_value="", description="Topic of the clouds; may be empty if the bag has only one."
            ),
            DeclareLaunchArgument("rate", default_value="1.0", description="Speed factor of the replay."),
            DeclareLaunchArgument(
                "loop", default_value="false", choices=["true", "false"], description="Restart the bag at its end."
            ),
            DeclareLaunchArgument("scores", default_value="", description="JSON file for the scores."),
            DeclareLaunchArgument(
                "config",
                default_value="",
                description="Comma-separated parameter files, loaded after config/replay*.param.yaml.",
            ),
            DeclareLaunchArgument(
                "single",
                default_value="false",
                choices=["true", "false"],
                description="Let each detector compute ground and clusters itself.",
            ),
            DeclareLaunchArgument(
                "rviz",
                default_value="false",
                choices=["true", "false"],
                description="Start RViz with config/lidar_perception.rviz.",
            ),
            DeclareLaunchArgument(
                "real_time",
                default_value="false",
                choices=["true", "false"],
                description="Play at the rate of the sensor; false: send a cloud "
                "once the clouds before it have results.",
            ),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="true",
                choices=["true", "false"],
                description="Take the time from /clock.",
            ),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, ..."),
            *(
                DeclareLaunchArgument(name, **options)
                for name, options in ARGUMENTS.items()
                if name not in (*VALUES, "rviz", *GRAPH)
            ),
            OpaqueFunction(function=lambda context: replay(context, given)),
        ]
    )
