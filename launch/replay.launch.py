"""Launch a replay of a bag through one or several detectors, and score them; it ends with the bag.

    ros2 launch lidar_perception replay.launch.py bag:=drive scores:=scores.json
    ros2 launch lidar_perception replay.launch.py bag:=drive detectors:=fused,pointpillars

The arguments of detectors.launch.py are also valid, except namespace and name_prefix.
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
from lidar_perception.data.bag_frames import choose_cloud_topic
from lidar_perception.nodes.graph import (
    FINAL_STAGE,
    configure_evaluator,
    list_awaited_topics,
    list_result_topics,
    make_relative,
)
from lidar_perception.nodes.launch_parameters import add_arguments, list_parameter_files, split_detectors
from lidar_perception.nodes.launching import ARGUMENTS as GRAPH_ARGUMENTS
from lidar_perception.nodes.launching import find_argument_names, reject_unknown_arguments
from lidar_perception.nodes.shared_memory import use_large_shared_memory
from lidar_perception.wire.clouds import CLOUD_TYPES
from lidar_perception.wire.topics import POINTS, TF_STATIC

# Arguments of detectors.launch.py that are always empty, because the player and the evaluator rely on this.
# They are passed explicitly, because an including file may have set arguments of these names.
FIXED_ARGUMENTS = {"namespace": "", "name_prefix": ""}
ARGUMENTS = {
    "bag": dict(description="Folder of the bag."),
    "detectors": dict(
        default_value="candidates",
        description="Comma-separated detectors to run and score: candidates, pointpillars, pointnet, fused.",
    ),
    "rate": dict(default_value="1.0", description="Speed factor of the replay."),
    "loop": dict(default_value="false", choices=["true", "false"], description="Restart the bag at its end."),
    "scores": dict(default_value="", description="JSON file for the scores."),
    "real_time": dict(
        default_value="false",
        choices=["true", "false"],
        description="true: play the clouds at the rate of the sensor; false: send a cloud "
        "once the previous ones have results, so that none is lost.",
    ),
    **{k: options for k, options in GRAPH_ARGUMENTS.items() if k not in FIXED_ARGUMENTS},
    "points": dict(
        default_value="", description="Topic of the clouds in the bag; if empty, /points or the only cloud topic."
    ),
    "config": dict(
        default_value="", description="Comma-separated parameter files, loaded after config/replay*.param.yaml."
    ),
    "use_sim_time": dict(default_value="true", choices=["true", "false"], description="Take the time from /clock."),
}
HERE = Path(__file__).resolve().parent
CONFIG = HERE.parent / "config" / "replay.param.yaml"
# Evaluation protocol of the STM-CPA paper, used if the candidates are replayed.
PAPER_CONFIG = HERE.parent / "config" / "replay_candidates.param.yaml"
GLOBAL_TOPICS = {TF_STATIC, "/tf", "/clock", "/diagnostics"}  # topics that are never remapped
LAST_FRAME_DELAY_S = 1.0  # time for the last frame to be scored after the bag has ended


def replay(context, argument_names):
    reject_unknown_arguments(argument_names, context, ARGUMENTS)
    value = {k: context.perform_substitution(LaunchConfiguration(k)) for k in ARGUMENTS}
    single, detectors = value["single"] == "true", split_detectors(value["detectors"])
    package_files = [str(CONFIG), *([str(PAPER_CONFIG)] if "candidates" in detectors else [])]
    files = [*package_files, *list_parameter_files(value["config"])]
    use_large_shared_memory()  # set here because the nodes would treat the player as a sensor driver
    with Bag(value["bag"]) as bag:
        cloud_topic = choose_cloud_topic(bag, value["points"], "points:={topic}")
        topics = [t for t, kind in bag.topics.items() if t == cloud_topic or kind not in CLOUD_TYPES]
    sim_time = {"use_sim_time": value["use_sim_time"] == "true"}
    log_level = ["--log-level", value["log_level"]]
    remap, scoring = configure_evaluator(value["scores"], single, detectors)
    detection_topics = [make_relative(list_result_topics(single, name)[FINAL_STAGE]) for name in detectors]
    real_time = value["real_time"] == "true"
    # Left out if empty, because launch cannot determine the type of an empty list.
    follow = {} if real_time else {"follow": detection_topics}
    cloud_subscribers = len(detectors) if single else 1
    detection_subscribers = 1 if real_time else 2  # the evaluator, and the player if it follows
    wait_for = [
        *list_awaited_topics(detectors, single, cloud_subscribers),
        *(f"{topic}:={detection_subscribers}" for topic in detection_topics),
    ]
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
                "topics": topics,
                **follow,
                "wait_for": wait_for,
            },
        ),
        # Relative names, which follow the namespace if this file is included in one.
        remappings=[(t, make_relative(POINTS if t == cloud_topic else t)) for t in topics if t not in GLOBAL_TOPICS],
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
    end = TimerAction(
        period=LAST_FRAME_DELAY_S, actions=[EmitEvent(event=Shutdown(reason="reached the end of the bag"))]
    )
    graph = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(HERE / "detectors.launch.py")),
        launch_arguments={"points": make_relative(POINTS), **FIXED_ARGUMENTS, "config": ",".join(files)}.items(),
    )
    configurations = context.launch_configurations
    return [
        *(
            LogInfo(msg=f"{name}:={configurations[name]} is ignored: it is not an argument of replay.launch.py")
            for name, fixed_value in FIXED_ARGUMENTS.items()
            if configurations.get(name, fixed_value) != fixed_value
        ),
        player,
        evaluator,
        RegisterEventHandler(OnProcessExit(target_action=player, on_exit=[end])),
        graph,
    ]


def generate_launch_description():
    argument_names = find_argument_names()
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, **options) for name, options in ARGUMENTS.items()),
            OpaqueFunction(function=lambda context: replay(context, argument_names)),
        ]
    )
