"""demo: the main job, from a bag through the nodes to a score."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import click

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.classes import CLASSES, PEDESTRIAN
from lidar_perception.cli.data import WHAT, a_path, opened
from lidar_perception.cli.evaluate.candidates import view_as_recorded
from lidar_perception.cli.options import parameter_options
from lidar_perception.data.bag import Bag
from lidar_perception.data.bag_frames import BagFrames
from lidar_perception.data.frame import BOXES, Recording
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.groups import renumbered
from lidar_perception.nodes.graph import cloud_topic, result_topics
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console, errors, track
from lidar_perception.scoring.centres.matching import match_centres
from lidar_perception.scoring.centres.tables import print_candidate_report
from lidar_perception.wire.messages import column, to_detections, to_frame
from lidar_perception.wire.topics import TRUTH
from lidar_perception.wire.track_markers import drawn_trails
from msg_utils.markers import from_marker_array


@click.command()
@a_path("--data", f"Replay this instead of the simulated drive: {WHAT}", "PATH")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/demo"),
              show_default=True, help="Folder for the results.")
@click.option("--frames", type=click.IntRange(1), default=40, show_default=True,
              help="Length of the simulated drive, 10 frames a second.")
@click.option("--drive-seed", type=click.IntRange(0), default=33, show_default=True,
              help="Seed of the simulated drive.")
@click.option("--rate", type=click.FloatRange(0.01, 100), default=1.0, show_default=True,
              help="Speed of the replay.")
@click.option("--single", is_flag=True, help="Run all stages in one process instead of three.")
@click.option("--real-time", is_flag=True, help="Play at the speed of the sensor, even if the "
                                                "machine cannot keep up. Without it each cloud is "
                                                "sent once those before it have their results.")
@parameter_options(PAPER)
def demo(data: Path | None, out: Path, frames: int, drive_seed: int, rate: float, single: bool,
         real_time: bool, params: PipelineParams) -> None:
    """Replay a drive through the real nodes over DDS and score the pedestrian candidates, and the
    tracks of them.

    Without options: makes a simulated drive with walking pedestrians, writes it as a rosbag2 bag,
    replays it into the nodes, each in its own process on a private ROS domain, and prints the
    scores. Leaves in --out: the bag, the result bag, scores.json, birdseye.png and the logs.

    \b
    Examples:
      lidar-perception demo
      lidar-perception demo --data /data/kitti/tracking
      lidar-perception demo --data drive.bag --rate 0.5 --single
    """
    recording = None if data is None else opened(data)
    for old in ("drive", "result", "logs"):
        shutil.rmtree(out / old, ignore_errors=True)
    drive = _bag(out / "drive", recording, frames, drive_seed)
    played = open_recording(drive)
    played.require(BOXES, "demo")
    clouds, params = len(played), view_as_recorded(played, params)
    from lidar_perception.nodes.replay import replay
    with errors.status("loading compiled code (the first time: compiling, about a minute)"):
        warm_up()
    content = replay(drive, clouds, out, params, rate=rate, single=single,
                     real_time=real_time)
    print_candidate_report(content, console)
    latency = content["latency_ms"]
    slower = content["slower"]
    pace = f"{rate:g}x" if slower < 1.05 else f"{rate / slower:.2g}x, {slower:.2g} times slower " \
        "than asked for, as the machine cannot keep up"
    console.print(f"{clouds} clouds replayed at {pace}; {content['results']} results; latency "
                  f"cloud to candidates median {latency['median']:.0f} ms, 95 % under "
                  f"{latency['p95']:.0f} ms; memory of the graph {content['memory_mb']:.0f} MB")
    content["tracks"] = _print_tracks(out / "result", played, content["poses"])
    write_text(out / "scores.json", json.dumps(content, indent=1))
    picture = _draw_best(out / "result", out / "birdseye.png", single)
    console.print(f"results in {out}: result (bag), scores.json, logs"
                  + (", birdseye.png" if picture else ""))
    console.print(f"look at it: lidar-perception view {out / 'result'}", soft_wrap=True)
    if missing := clouds - content["results"]:
        errors.print(f"[red]{missing} clouds gave no result[/]" + (
            "; without --real-time none is dropped" if real_time else f"; see {out}/logs"))
        if not real_time:
            raise SystemExit(1)


def _bag(path: Path, recording: Any, frames: int, drive_seed: int) -> Path:
    """The bag to replay: the one that was given, or one made of it, or of a simulated drive."""
    if recording is not None and isinstance(recording.frames, BagFrames):
        return recording.path
    if recording is not None:
        found = track(recording, f"converting {recording.path}", len(recording))
    else:
        from lidar_perception.simulation.scene import CROWDED
        from lidar_perception.simulation.to_bag import simulated_scans
        found = track(simulated_scans(drive_seed, frames, streets=CROWDED), "simulating a drive",
                      frames)
    write_bag(path, found, force=True)
    return path


POSES = {"odometry": "poses of the recording",
         "kiss_icp": "poses by KISS-ICP, as the recording has none",
         None: "relative to the sensor, as the recording has no poses, and kiss-icp is not "
               "installed: pip install 'lidar_perception[odometry]'"}


def _print_tracks(result: Path, played: Recording, poses: str | None) -> dict:
    """Say how many pedestrians were tracked, how well, and with which poses; the scores."""
    from lidar_perception.nodes.replay import TRACKS
    from lidar_perception.scoring.tracking.from_bag import recorded_tracks
    person = CLASSES[PEDESTRIAN]
    count, scores, problem = recorded_tracks(result, TRACKS, person,
                                             next(iter(played)).calibration())
    text = f"HOTA is not known: {problem}" if scores is None else (
        f"{scores['true_tracks']} labelled; {scores['switches']} identity switches, HOTA "
        f"{100 * scores['HOTA']:.1f} (detection {100 * scores['DetA']:.1f}, association "
        f"{100 * scores['AssA']:.1f})")
    console.print(f"tracks: {count} of pedestrians, {text}; {POSES[poses]}")
    return {"found": count, "scores": scores}


def _draw_best(result: Path, picture: Path, single: bool) -> bool:
    """Draw the recorded frame with most hits, and the ways of tracks; False if none has a labelled
    pedestrian."""
    from lidar_perception.nodes.replay import TRACKS
    from lidar_perception.scoring.pictures import draw_frame
    final = result_topics(single)["final"]
    frames: dict[int, dict] = {}
    trails: dict[int, dict] = {}
    with Bag(result) as bag:
        for topic, _, msg in bag.messages({TRUTH, final, TRACKS} & set(bag.topics)):
            if topic == TRACKS:
                trails[from_marker_array(msg).stamp_ns] = drawn_trails(msg)
                continue
            objects = from_marker_array(msg)
            boxes = (to_detections(objects).boxes if topic == final
                     else objects.boxes[[x == CLASSES[PEDESTRIAN] for x in objects.labels]])
            frames.setdefault(objects.stamp_ns, {})[topic] = boxes
        hits = {stamp: (len(match_centres(f[final], f[TRUTH])[0]), len(f[TRUTH]))
                for stamp, f in frames.items() if len(f) == 2 and len(f[TRUTH])}
        if not hits:
            return False
        best = max(hits, key=lambda s: (hits[s], s))  # the last of them: its trails are longest
        for _, _, msg in bag.messages({cloud_topic(single)}):
            frame, indices = to_frame(msg)
            if frame.stamp_ns == best:
                ids, _ = renumbered(column(msg, "cluster_id", indices))
                draw_frame(picture, frame.xyz, column(msg, "ground", indices) > 0, ids,
                           frames[best][TRUTH],
                           frames[best][final], trails=trails.get(best, {}),
                           title=f"{hits[best][0]} of {hits[best][1]} pedestrians found, stamp "
                           f"{best / 1e9:.1f} s")
                return True
    return False
