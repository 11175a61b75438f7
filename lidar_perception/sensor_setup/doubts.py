"""What is doubtful of what was measured, each in one line with the remedy."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.geometry import wrap_angle
from lidar_perception.sensor_setup.coverage import FAR
from lidar_perception.sensor_setup.measure import FEW_SCANS, SMALL_ROOM, Measured
from lidar_perception.sensor_setup.motion import Ahead
from lidar_perception.sensor_setup.told import FOOTPRINT
from lidar_perception.simulation.sensor import sensor_named

SLOPE = 1.0         # degrees by which the ground leans from scan to scan, from which on it slopes
TALL = 5.0          # metres above the ground, more than robots have
STEEP_MOUNT = 6.0   # degrees of roll or pitch: either mounted so, or all of it on a slope
NOT_AHEAD = 10.0    # degrees between x and where the robot drives, beyond twice the error
TILT_APART = 2.0    # degrees between what TF and the ground say of roll or pitch, beyond the error:
                    # the camber of one road is as much
HEIGHT_APART = 0.1  # metres, likewise
MANY_LOST = 0.01    # share of missing clouds
SHORTEST_TURN = 0.02  # s; times that span less are no turn


def doubts(m: Measured) -> list[str]:
    """What is doubtful, each in one line with the remedy."""
    out = []
    if len(m.scans) == 1:
        out.append("one cloud only: the body, blind sectors and losses cannot be told; record some "
                   "minutes while the robot drives")
    elif m.coverage.still:
        out.append("the robot stands still: all is of one place, and its body cannot be told from "
                   "what is around it; record while it drives")
    elif m.coverage.still is None:
        out.append("whether the robot moved cannot be told, as too few directions have a return "
                   f"from beyond {FAR:.0f} m in most of the clouds; record one drive through an "
                   "open place")
    frames = sorted({scan.frame_id for scan in m.scans} - {""})
    if len(frames) > 1:
        out.append(f"clouds of several frames ({', '.join(frames)}) share the topic: this is no "
                   "single sensor; record each on a topic of its own")
    if m.beams is None:
        out.append("points lie on no beams about the z axis: the pattern does not repeat, clouds "
                   "are joined or moved, or their frame is turned against the sensor; sensor.yaml "
                   "has a grid of the same view instead; record the driver's own cloud if you can")
    else:
        out += _beam_doubts(m)
    out += _mount_doubts(m)
    out += _heading_doubts(m) + told_doubts(m)
    if m.intensity is None:
        out.append("there is no intensity, or always the same: detectors that were trained with it "
                   "lose accuracy; turn it on in the driver, or train with --sensor sensor.yaml, "
                   "which has none either (silent: 1)")
    elif not m.intensity.sure:
        out.append(f"intensities end at {m.intensity.greatest:g}, so that the full scale "
                   f"({m.intensity.full:g}) is a guess: no retroreflector was in sight, or the "
                   "driver has another scale; look it up and set input.intensity_max")
    times = m.scans[0].seconds
    if times is not None and np.nanmax(times) - np.nanmin(times) < SHORTEST_TURN:
        out.append(f"the times of the points span {1000 * np.ptp(times):.1f} ms, which is no turn: "
                   "they count something else or in another unit; do not correct motion by them")
    if m.scans[0].time_problem:
        out.append(f"{m.scans[0].time_problem}; motion is not corrected by such a column")
    if not np.isfinite(m.timing.rate):
        out.append("the rate cannot be told without stamps or times; set rate in sensor.yaml")
    if m.timing.missing > MANY_LOST * m.total:
        out.append(f"{m.timing.missing} clouds are missing between the stamps: the recorder or the "
                   "network lost them; see docs/explanation/reliability.md")
    if m.timing.backwards:
        out.append(f"{m.timing.backwards} stamps are not after the one before: two sources share "
                   "the topic, or clocks jump; synchronise the sensor's clock")
    if m.greatest < SMALL_ROOM:
        out.append(f"nothing is farther than {m.greatest:.0f} m: this is the room, not the "
                   "sensor's range; max_range in sensor.yaml is "
                   + ("that of the model" if m.model else "a guess"))
    c = m.coverage
    if c.walls:
        out.append("more stays at the same place around the robot than a body has, as walls and "
                   "ceilings along its way do, so that no crop.body and no sector that it hides is "
                   "set; record one drive through an open place, or set crop.body by hand by the "
                   "report")
    elif len(c.box) and not c.fits:
        out.append(f"{100 * c.others:.0f} % of the points in the box around the robot's own "
                   "returns are not its own, so no crop.body and no sector that it hides is set; "
                   "set crop.body by hand by the report")
    if m.twice > 0.05:
        out.append(f"{100 * m.twice:.0f} % of the points share the direction of another, as second "
                   "returns do; turn them off if the detectors need not see through dust or glass")
    return out


def _beam_doubts(m: Measured) -> list[str]:
    out = []
    beams = m.beams
    assert beams is not None
    if m.model and len(beams.elevations) < sensor_named(m.model).rings:
        out.append(f"{len(beams.elevations)} of the {sensor_named(m.model).rings} beams of "
                   f"{m.model} were seen, so sensor.yaml has all of the model's: record where all "
                   "of them meet something to measure them")
    if m.moved:
        out.append(f"points of a beam scatter by {np.median(beams.spread):.2f} deg: the clouds are "
                   "corrected for motion, or in a frame that is not the sensor's, whose height it "
                   "then is, and steep beams are less sure"
                   + (f", so that sensor.yaml has those of {m.model}" if m.as_model else "")
                   + "; record the driver's own cloud")
    elif beams.lifts.any() and len(m.scans) < FEW_SCANS:
        out.append("the beams start at different heights, which a few scans do not tell well; "
                   "record more")
    return out


def _mount_doubts(m: Measured) -> list[str]:
    if m.on_ground:
        return ["the clouds are in a frame on the ground, such as base_footprint, so that height, "
                "roll and pitch of the sensor are not known; give the driver's own cloud"]
    if m.mount is None:
        return ["no ground in sight, so that height, roll and pitch are not known; record where "
                "the floor is seen for some metres around, or set ground.sensor_pose by hand"]
    out, q = [], m.mount
    if q.height > TALL:
        out.append(f"what is taken for the ground is {q.height:.1f} m away: it may be a wall "
                   "beside a sensor that lies on its side; look in the report, and set "
                   "ground.sensor_pose by hand")
    if q.upside_down:
        out.append("the ground is where the sensor's z axis points: it is mounted upside down, and "
                   "ground.sensor_pose.roll says so; with z down in the driver's frame only, turn "
                   "that frame instead")
    found = sum(p is not None for p in q.planes)
    if found < 0.9 * len(m.scans):
        out.append(f"ground was found in {found} of {len(m.scans)} scans only; record where the "
                   "floor is free around the robot")
    if np.degrees(q.spread[1:]).max() > SLOPE:
        out.append(f"the ground leans by {np.degrees(q.spread[1:]).max():.1f} deg from scan to "
                   "scan: slopes, curves or a swaying robot; record on level ground, or longer")
    if not q.level:
        out.append("simulate and train have a level sensor: in sensor.yaml it does not lean, and "
                   "no sectors are blind but those beside its view; nodes, and convert --robot, "
                   "level the clouds by robot.param.yaml")
    lean = np.degrees([np.arctan2(np.sin(q.roll), abs(np.cos(q.roll))), q.pitch])
    if np.abs(lean).max() > STEEP_MOUNT and (len(m.scans) < FEW_SCANS or m.coverage.still):
        out.append(f"the sensor leans by {np.abs(lean).max():.0f} deg against the ground, which "
                   "may be a slope as well as its mount; record in several places")
    return out


def _heading_doubts(m: Measured) -> list[str]:
    h = m.heading
    if h is None or len(m.scans) == 1:
        return []  # that there is no ground, or no motion, is said
    if h.unknown:
        return [f"yaw not known: {h.unknown}; record while it drives some metres straight ahead, "
                "or check that x of the clouds looks ahead"]
    if not looks_elsewhere(h):
        return []
    found = (f"the robot drives towards {h.degrees:.0f} deg of the cloud's x axis, where detectors "
             "look ahead")
    if may_be_backwards(h):
        return [f"{found}: the frame is turned about z, unless it was driven backwards; if it is "
                f"turned, set input.ahead to {h.degrees:.0f}"]
    return [f"{found}: input.ahead lets those of nodes look there; for commands that read the "
            "recording, convert --robot robot.param.yaml makes a bag with x ahead"]


def looks_elsewhere(h: Ahead) -> bool:
    """Whether x does not look ahead."""
    return not h.unknown and abs(h.degrees) - 2 * h.error > NOT_AHEAD


def may_be_backwards(h: Ahead) -> bool:
    """Whether x may look ahead all the same, of a robot that drove backwards."""
    return not h.base and abs(h.degrees) > 180 - 2 * NOT_AHEAD


def turned(degrees: float | np.ndarray) -> Any:
    """Degrees as a turn by at most half a circle, -180 .. 180."""
    return np.degrees(wrap_angle(np.radians(degrees)))


def told_doubts(m: Measured) -> list[str]:
    """What of TF and odometry the clouds contradict."""
    told, q, h, out = m.told, m.mount, m.heading, []
    if told.left_out:
        out.append(f"{told.left_out} transforms or poses of the odometry are none (not finite, or "
                   "no rotation) and were left out: look at what publishes them")
    if told.unposed:
        out.append(f"how the robot moved is told by the clouds alone: {told.unposed}; record the "
                   "odometry, or the TF, all the time, with the base as child_frame_id and by the "
                   "clock of the clouds")
    if q is not None and told.mount is not None:
        by_ground, error = np.degrees([q.roll, q.pitch]), np.degrees(q.error[1:])
        apart = turned(by_ground - told.roll_pitch)
        if (np.abs(apart) > TILT_APART + 2 * error).any():
            out.append(f"TF has the sensor in '{told.base}' with roll {told.roll_pitch[0]:.1f} and "
                       f"pitch {told.roll_pitch[1]:.1f} deg, the ground says {by_ground[0]:.1f} "
                       f"and {by_ground[1]:.1f}: correct the robot's description (URDF), which "
                       "base_frame goes by, or do without base_frame")
    if q is not None and abs(q.height - told.height) > HEIGHT_APART + 2 * q.error[0]:
        out.append(f"TF has the sensor {told.height:.2f} m above '{FOOTPRINT}', and it is "
                   f"{q.height:.2f} m above the ground: correct the URDF, which base_frame goes by")
    if h is not None and not h.unknown and told.mount is not None:
        if abs(turned(h.degrees - told.ahead)) - 2 * h.error > NOT_AHEAD:
            out.append(f"by TF, x of '{told.base}' looks {told.ahead:.0f} deg from the clouds' x "
                       f"axis, and the robot drives towards {h.degrees:.0f}: correct the yaw in "
                       "the URDF" + ("" if h.base else ", unless it was driven another way"))
    return out
