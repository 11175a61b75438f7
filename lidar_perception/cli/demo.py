"""demo: replay a drive through the nodes, and score the result."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.text import Text

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.classes import DETECTED
from lidar_perception.cli.command import Choice, Command, refuse_options
from lidar_perception.cli.data import DATA_HELP, data_argument, open_and_describe, out_folder_option
from lidar_perception.cli.evaluate.candidates import with_recorded_setup
from lidar_perception.cli.options import (
    CANDIDATES,
    Algorithm,
    Settings,
    apply_values,
    device_option,
    make_candidate_algorithm,
    make_detector_algorithm,
    make_detector_choice,
    range_option,
    settings_options,
)
from lidar_perception.data.bag import Bag
from lidar_perception.data.bag_frames import BagFrames
from lidar_perception.data.frame import BOXES, Recording
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detectors.contract import FUSED
from lidar_perception.detectors.open import DetectorChoice, open_detector
from lidar_perception.groups import renumber_ids
from lidar_perception.nodes import require_rclpy
from lidar_perception.nodes.graph import FINAL_STAGE, SINGLE_PROCESS_NODES, find_result_cloud_topic, list_result_topics
from lidar_perception.runs.compiling import compile_in_background
from lidar_perception.runs.files import make_folder, write_text
from lidar_perception.runs.terminal import console, errors, show_progress
from lidar_perception.scoring.centres.matching import match_centres
from lidar_perception.scoring.centres.tables import print_candidate_report
from lidar_perception.scoring.recorded import RecordedResult, read_results
from lidar_perception.tracking import tracker
from lidar_perception.tracking.ego import NO_SOURCE
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError, find_class_ids
from lidar_perception.wire.messages import read_column, to_detections, to_point_cloud, to_truth
from lidar_perception.wire.topics import POINTS
from lidar_perception.wire.track_markers import read_trails
from msg_utils.markers import from_marker_array
from msg_utils.stamps import to_ns

RECORD = "demo.json"  # file in the output folder that names the data and the detector
MAX_BEHIND_M = 2.0  # the picture shows all directions if a detection is farther behind the sensor
REPLACED_FOLDERS = ("drive", "result", "logs")  # subfolders that the next demo replaces


def _make_algorithm(detector: str) -> Algorithm:
    """Return the parameters of the detector that the nodes run."""
    return (
        make_candidate_algorithm(in_nodes=True)
        if detector == CANDIDATES
        else make_detector_algorithm(detector, in_nodes=True)
    )


@click.command(cls=Command)
@data_argument(f"Replay this instead of the simulated drive; it needs labelled boxes: {DATA_HELP}", required=False)
@click.option(
    "--detector", type=Choice(SINGLE_PROCESS_NODES), default=FUSED, show_default=True, help="Detector to run."
)
@out_folder_option("Folder for the results.", default=Path("out/demo"), show_default=True)
@click.option(
    "--frames",
    type=click.IntRange(1),
    default=40,
    show_default=True,
    help="Length of the simulated drive, at 10 frames per second.",
)
@click.option(
    "--drive-seed", type=click.IntRange(0), default=38, show_default=True, help="Seed of the simulated drive."
)
@click.option(
    "--rate", type=click.FloatRange(0.01, 100), default=1.0, show_default=True, help="Speed factor of the replay."
)
@click.option("--single", is_flag=True, help="Run ground, clusters and detector in one process instead of three.")
@click.option(
    "--processes/--one-process",
    default=None,
    help="Run each node in its own process, or all nodes in one process, which saves "
    "memory and is the default on machines with up to four cores.",
)
@click.option(
    "--real-time",
    is_flag=True,
    help="Play in real time, even if the machine cannot keep up. By default, each cloud waits for the results of "
    "earlier ones.",
)
@range_option
@device_option
@settings_options(lambda options: [_make_algorithm(options.get("detector") or FUSED)], candidates=True)
def demo(
    data: Path | None,
    detector: str,
    out: Path,
    frames: int,
    drive_seed: int,
    rate: float,
    single: bool,
    processes: bool | None,
    real_time: bool,
    range: str,
    device: str,
    settings: Settings,
) -> None:
    """Replay a drive through the real nodes over DDS, and score the detections and their tracks.

    Without DATA, simulates a drive with traffic and walking pedestrians and writes it as a rosbag2
    bag. Replays the bag into the nodes on a private ROS domain and prints the scores. Writes to
    --out: the bag, the result bag, scores.json, birdseye.png and the logs. With --detector
    candidates, scores only pedestrians, by the protocol of the STM-CPA paper.

    DATA needs labelled boxes, because the results are scored. For a recording without labels use
    `detect` or `view DATA --weights fused`, and `setup` to measure its sensor.

    \b
    Examples:
      lidar-perception demo
      lidar-perception demo /data/kitti/tracking
      lidar-perception demo drive.bag --rate 0.5 --single
      lidar-perception demo --detector candidates --config best
    """
    if data is not None:
        refuse_options(("frames", "drive_seed"), "applies to the simulated drive, which DATA replaces")
    (values,) = settings.resolve(_make_algorithm(detector))
    if detector == CANDIDATES and (range != "auto" or device != "auto"):
        raise click.UsageError("--range and --device require a detector with a network")
    choice = make_detector_choice(detector, range, device, values, PAPER if detector == CANDIDATES else None)
    require_rclpy()  # checked before the drive is simulated
    recording = None if data is None else open_and_describe(data)
    if recording is not None:
        recording.require(BOXES, "demo")
    _remove_old_results(out, data, detector)
    make_folder(out / "logs")
    with compile_in_background(_write_compile_code(choice), out / "logs" / "compile.log", errors.print):
        drive = _make_drive_bag(out / "drive", recording, frames, drive_seed)
    replayed_bag = _open_replayed_bag(drive, recording)
    clouds = len(replayed_bag)
    from lidar_perception.nodes.replay.graph_replay import TRACKS, replay

    with errors.status("loading compiled code (the first time: compiling, half a minute or more)"):
        node_params = _load_node_params(choice, replayed_bag)
    content = replay(
        drive,
        clouds,
        out,
        node_params,
        detector=detector,
        rate=rate,
        single=single,
        real_time=real_time,
        processes=processes,
    )
    final_topic = list_result_topics(single, detector)[FINAL_STAGE]
    detections, tracks = read_results(out / "result", final_topic, TRACKS)
    calibration = next(iter(replayed_bag)).calibration()
    if detector == CANDIDATES:
        print_candidate_report(content, console)
    else:
        content["detections"] = _print_detections(detections, calibration)
    _print_pace(content, rate, clouds)
    content["tracks"] = _print_tracks(tracks, calibration, content["poses"])
    write_text(out / "scores.json", json.dumps(content, indent=1))
    has_picture = _draw_best(
        out,
        find_result_cloud_topic(single, detector),
        _select_drawn_objects(detections, detector),
        next(iter(replayed_bag)).sensor_height,
    )
    console.print(f"results in {out}: result (bag), scores.json, logs" + (", birdseye.png" if has_picture else ""))
    console.print(f"to view it: lidar-perception view {out / 'result'}")
    if missing_count := clouds - content["results"]:
        errors.print(
            Text(f"{missing_count} clouds produced no result", "red")
            + ("; without --real-time, no cloud is dropped" if real_time else f"; see {out}/logs")
        )
        if not real_time:
            raise SystemExit(1)


def _remove_old_results(out: Path, data: Path | None, detector: str) -> None:
    """Remove the results of an earlier demo in `out`.

    Raises:
        InputError: `out` holds other files.
    """
    old_folders = [out / name for name in REPLACED_FOLDERS if (out / name).exists()]
    if old_folders and not (out / RECORD).is_file():
        raise InputError(
            f"{old_folders[0]} exists without a {RECORD}, so demo did not create it; remove it, or give another --out"
        )
    for folder in old_folders:
        if data is not None and data.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{data} would be replaced; give another --out")
    for folder in old_folders:
        shutil.rmtree(folder, ignore_errors=True)
    write_text(out / RECORD, json.dumps({"data": data and str(data), "detector": detector}))


def _open_replayed_bag(path: Path, recording: Recording | None) -> Recording:
    """Open the bag to replay, with the sensor height of the recording that it was converted from."""
    return open_recording(path, sensor_height=None if recording is None else recording.frames[0].sensor_height)


def _load_node_params(choice: DetectorChoice, replayed_bag: Recording) -> Any:
    """Return the parameters of the nodes, and compile their shared code once for all of them."""
    if choice.weights == CANDIDATES:
        warm_up()
        return with_recorded_setup(replayed_bag, apply_values(PAPER, choice.settings))
    return choice.open(sensor_height=replayed_bag.frames[0].sensor_height).params


def _write_compile_code(choice: DetectorChoice) -> str:
    """Return Python code that compiles the tracker, the detector and the reading of its inputs."""
    lines = [f"from {tracker.__name__} import warm_up", "warm_up()"]
    if choice.weights == CANDIDATES:
        lines += [f"from {warm_up.__module__} import warm_up", "warm_up()"]
    else:
        lines += [
            f"from {open_detector.__module__} import open_detector",
            f"open_detector({choice.weights!r}, {choice.device!r}, range={choice.range!r})",
        ]
    return "; ".join(lines)


def _make_drive_bag(path: Path, recording: Any, frames: int, drive_seed: int) -> Path:
    """Return the bag to replay: the recording itself, or one written from it or a simulated drive."""
    if (
        recording is not None
        and isinstance(recording.frames, BagFrames)
        and (recording.frames.points == POINTS and recording.frames.poses.needs_no_tf)
    ):
        return recording.path
    if recording is not None:
        frames_to_write = show_progress(recording, f"converting {recording.path}", len(recording))
    else:
        from lidar_perception.simulation.recording import simulate_frames
        from lidar_perception.simulation.scene import CROWDED_ZONES

        frames_to_write = show_progress(
            simulate_frames(drive_seed, frames, scenes=CROWDED_ZONES), "simulating a drive", frames
        )
    write_bag(path, frames_to_write, force=True)
    return path


def _print_detections(frames: Sequence[RecordedResult], calibration: Any) -> dict:
    """Print the detection scores by class, for labels in the camera's view; return them."""
    from lidar_perception.scoring.detections import FrameDetections
    from lidar_perception.scoring.kitti.default_threshold import print_scores_at_threshold, score_at_threshold
    from lidar_perception.scoring.kitti.report import DetectionReport

    report = DetectionReport()
    for frame in frames:
        report.update(
            FrameDetections(str(frame.stamp_ns), to_truth(frame.truth), to_detections(frame.objects), calibration)
        )
    scores = score_at_threshold(report.frames)
    print_scores_at_threshold(scores, len(frames), console)
    return scores


def _print_pace(content: dict, rate: float, clouds: int) -> None:
    latency, stages, speed = content["latency_ms"], content["stage_ms"], rate / content["slower"]
    pace_text = f"{rate:g}x real time"
    if content["slower"] >= 1.05 and stages:
        slowest = max(stages, key=lambda node: stages[node])
        pace_text = f"{speed:.2g}x real time: {slowest} needs {stages[slowest]:.0f} ms per cloud on this machine"
    console.print(f"{clouds} clouds replayed at {pace_text}")
    latency_text = (
        f"latency from cloud to tracks: median {latency['median']:.0f} ms, 95th percentile {latency['p95']:.0f} ms"
        if latency["median"]
        else "latency not measured, because too few results arrived while the bag was played"
    )
    console.print(f"{content['results']} results; {latency_text}; memory of the graph {content['memory_mb']:.0f} MB")
    cpu_ms = sum(content["cpu_ms_by_process"].values())
    console.print(
        "time per cloud: "
        + ", ".join(f"{node} {ms:.0f} ms" for node, ms in stages.items())
        + (f"; CPU time of all processes {cpu_ms:.0f} ms" if content["results"] > 1 else "")
    )


def _print_tracks(frames: Sequence[RecordedResult], calibration: Any, poses: str) -> dict:
    """Print the scores of the tracks by class and the source of the poses; return the scores."""
    from lidar_perception.scoring.tracking.from_bag import count_recorded_tracks, score_recorded_tracks
    from lidar_perception.scoring.tracking.tables import EGO_TITLES

    count, result = count_recorded_tracks(frames), {}
    try:
        result = score_recorded_tracks(frames, calibration)
    except InputError as error:
        console.print(f"tracks: {count}; HOTA is not available: {error}")
    for name in DETECTED:
        if scores := result.get(name):
            console.print(
                f"tracks of {name}: {count.get(name, 0)}, {scores['true_tracks']} labelled; "
                f"{scores['switches']} identity switches, HOTA {100 * scores['HOTA']:.1f} "
                f"(detection {100 * scores['DetA']:.1f}, association {100 * scores['AssA']:.1f})"
            )
    remedy = "; pip install 'lidar_perception[odometry]' to estimate them from the scans"
    console.print(f"tracking with {EGO_TITLES[poses]}{remedy * (poses == NO_SOURCE)}")
    return {"found": count, "scores": result}


def _select_drawn_objects(frames: Sequence[RecordedResult], detector: str) -> dict[int, tuple[np.ndarray, Any]]:
    """Return {stamp: (labelled boxes, detected objects)}, with the classes that the detector supports."""
    names = {CLASSES[PEDESTRIAN]} if detector == CANDIDATES else {*DETECTED}
    return {f.stamp_ns: (f.truth.boxes[[label in names for label in f.truth.labels]], f.objects) for f in frames}


def _draw_best(out: Path, cloud: str, frames: dict[int, tuple[np.ndarray, Any]], height: float) -> bool:
    """Draw the recorded frame with the most matches, and its tracks. Return False if no frame has labels."""
    from lidar_perception.nodes.replay.graph_replay import TRACKS
    from lidar_perception.rendering.colors import color_by_cluster
    from lidar_perception.rendering.files import write_png
    from lidar_perception.rendering.picture import Boxes, RenderSettings, draw_frame

    counts = {  # (matches, labels) by stamp
        stamp: (len(match_centres(detections.boxes, truth)[0]), len(truth))
        for stamp, (truth, detections) in frames.items()
        if len(truth)
    }
    if not counts:
        return False
    best_stamp = max(counts, key=lambda s: (counts[s], s))  # of equal frames the last one, whose trails are the longest
    truth, detections = frames[best_stamp]
    trails: dict[int, np.ndarray] = {}
    cloud_msg = None
    with Bag(out / "result") as bag:
        for topic, _, msg in bag.messages({cloud, TRACKS} & set(bag.topics)):
            if topic == TRACKS:
                if msg.markers and to_ns(msg.markers[0].header.stamp) == best_stamp:
                    detections, trails = from_marker_array(msg), read_trails(msg)
            elif to_ns(msg.header.stamp) == best_stamp:
                cloud_msg = msg
    if cloud_msg is None:
        return False
    frame, indices = to_point_cloud(cloud_msg)
    ground = read_column(cloud_msg, "ground", indices)
    ids = read_column(cloud_msg, "cluster_id", indices)
    zeros = np.zeros(len(frame), int)
    colors = None if ground is None else color_by_cluster(ground > 0, zeros if ids is None else renumber_ids(ids)[0])
    boxes = Boxes(
        detections.boxes,
        np.array(find_class_ids(detections.labels), int),
        [str(i) if trails else "" for i in detections.ids],
        [trails.get(int(i), detections.boxes[k : k + 1, :3]) for k, i in enumerate(detections.ids)],
    )
    render_settings = RenderSettings.of(frame, height, not (detections.boxes[:, 0] < -MAX_BEHIND_M).any())
    write_png(
        out / "birdseye.png",
        draw_frame(
            render_settings,
            frame,
            boxes,
            truth,
            f"{counts[best_stamp][0]} of {counts[best_stamp][1]} labelled objects detected",
            f"{best_stamp / 1e9:.1f} s",
            colors,
        ),
    )
    return True
