"""Warnings about a measurement, each in one line with the remedy."""

from __future__ import annotations

import numpy as np

from lidar_perception.sensor_setup.measurement.coverage import MIN_FAR_M
from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.sensor_setup.measurement.motion import MAX_OFF_AXIS, wrap_degrees
from lidar_perception.sensor_setup.measurement.recorded_poses import FOOTPRINT
from lidar_perception.simulation.sensor import find_sensor

MAX_SLOPE_SPREAD = 1.0  # max variation of the slope between scans of level ground, in degrees
MAX_HEIGHT_M = 5.0  # more than any robot has
MAX_TILT = 6.0  # max roll or pitch in degrees; more means a tilted mount, or a slope
MAX_TILT_DIFFERENCE = 2.0  # tolerance between TF and ground in degrees, beyond the error; allows for road camber
MAX_HEIGHT_DIFFERENCE_M = 0.1  # tolerance between the ground and TF or --height-hint
MAX_MISSING_SHARE = 0.01  # maximum fraction of missing clouds
MIN_GROUND_SHARE = 0.9  # minimum fraction of scans with ground
MIN_TURN_S = 0.02  # minimum span of the point times of a revolution
MAX_SECOND_RETURNS = 0.05  # maximum fraction of second returns


def find_warnings(m: SensorMeasurement) -> list[str]:
    """Return the warnings about a measurement."""
    return [
        *_check_motion(m),
        *_check_beams(m),
        *_check_mount(m),
        *_check_heading(m),
        *check_recorded_poses(m),
        *_check_columns(m),
        *_check_timing(m),
        *_check_view(m),
    ]


def _check_motion(m: SensorMeasurement) -> list[str]:
    warnings = []
    if len(m.source.scans) == 1:
        warnings.append(
            "only one cloud: the body, blind sectors and losses cannot be measured; "
            "record some minutes while the robot drives"
        )
    elif m.view.coverage.still:
        warnings.append(
            "the robot stands still, so its body cannot be separated from its surroundings; record while it drives"
        )
    elif m.view.coverage.still is None:
        warnings.append(
            "unknown whether the robot moved, as too few directions have a return from "
            f"beyond {MIN_FAR_M:.0f} m in most of the clouds; record a drive through "
            "an open place"
        )
    if len(m.source.frame_ids) > 1:
        warnings.append(
            f"clouds of several frames ({', '.join(m.source.frame_ids)}) share the "
            "topic, so they are of several sensors; record each on its own topic"
        )
    return warnings


def _check_beams(m: SensorMeasurement) -> list[str]:
    pattern = m.pattern
    beams = pattern.beams
    if beams is None:
        return [
            "there are no beams about the z axis: the pattern does not repeat, clouds are "
            "joined or moved, or their frame is rotated against the sensor; sensor.yaml has "
            "a grid of the same view instead; record the driver's own cloud if possible"
        ]
    warnings = []
    if pattern.model and len(beams.elevations) < find_sensor(pattern.model).rings:
        warnings.append(
            f"{len(beams.elevations)} of the {find_sensor(pattern.model).rings} beams "
            f"of {pattern.model} were seen, so sensor.yaml has all beams of the model; "
            "to measure them, record where all of them have returns"
        )
    if pattern.is_moved:
        warnings.append(
            f"points of a beam scatter by {np.median(beams.spread):.2f} deg: the "
            "clouds are corrected for motion, or in a frame that is not the sensor's, "
            "so the height is that of the frame and steep beams are less accurate"
            + (f"; sensor.yaml has the beams of {pattern.model}" if pattern.prefers_model else "")
            + "; record the driver's own cloud"
        )
    elif beams.lifts.any() and m.source.has_few_scans:
        warnings.append("the beams start at different heights, which few scans do not show well; record more")
    return warnings


def _check_mount(m: SensorMeasurement) -> list[str]:
    if m.mounting.on_ground:
        return [
            "the clouds are in a frame on the ground, such as base_footprint, so height, roll "
            "and pitch of the sensor are unknown; give the driver's own cloud"
        ]
    mount, scans = m.mounting.mount, m.source.scans
    if mount is None:
        return [
            "no ground in view, so height, roll and pitch are unknown; record where some "
            "metres of floor around the robot are visible, or set ground.sensor_pose by hand"
        ]
    warnings = []
    if mount.height > MAX_HEIGHT_M:
        warnings.append(
            f"the ground that was found is {mount.height:.1f} m away: it may be a wall "
            "next to a sensor that is mounted on its side; set ground.sensor_pose by "
            "hand"
        )
    hint = m.mounting.height_hint
    if hint is not None and abs(mount.height - hint) >= MAX_HEIGHT_DIFFERENCE_M:
        warnings.append(
            f"the sensor is {mount.height:.2f} m above the ground and not {hint:g}, as "
            "--height-hint says: measure it by hand"
        )
    if mount.upside_down:
        warnings.append(
            "the ground is in the direction of the sensor's z axis: the sensor is "
            "mounted upside down, as ground.sensor_pose.roll says; if only the "
            "driver's frame has z down, turn that frame instead"
        )
    found = sum(plane is not None for plane in mount.planes)
    if found < MIN_GROUND_SHARE * len(scans):
        warnings.append(
            f"ground was found in only {found} of {len(scans)} scans; record where the floor around the robot is free"
        )
    slope_spread = np.degrees(mount.spread[1:]).max()
    if slope_spread > MAX_SLOPE_SPREAD:
        warnings.append(
            f"the slope of the ground varies by {slope_spread:.1f} deg from scan to "
            "scan: slopes, curves or a swaying robot; record on level ground, or "
            "longer"
        )
    if not mount.is_level:
        warnings.append(
            "simulate and train use a level sensor: sensor.yaml has no tilt, and no "
            "blind sectors except outside the view; nodes, and convert --robot, level "
            "the clouds by robot.param.yaml"
        )
    tilt = np.degrees([np.arctan2(np.sin(mount.roll), abs(np.cos(mount.roll))), mount.pitch])
    if np.abs(tilt).max() > MAX_TILT and (m.source.has_few_scans or m.view.coverage.still):
        warnings.append(
            f"the sensor is tilted by {np.abs(tilt).max():.0f} deg against the ground, "
            "which may be a slope or its mount; record in several places"
        )
    return warnings


def _check_heading(m: SensorMeasurement) -> list[str]:
    heading = m.mounting.heading
    if heading is None or len(m.source.scans) == 1:
        return []  # missing ground or motion has its own warning
    if heading.problem:
        return [
            f"yaw unknown: {heading.problem}; record while the robot drives some metres "
            "straight ahead, or check that x of the clouds points ahead"
        ]
    if not heading.is_off_axis:
        return []
    direction = (
        f"the robot drives towards {heading.degrees:.0f} deg from the cloud's x axis, along which detectors look"
    )
    if heading.may_be_reversed:
        return [
            f"{direction}: the frame is turned about z, unless it was driven backwards; if it "
            f"is turned, set input.ahead to {heading.degrees:.0f}"
        ]
    return [
        f"{direction}: input.ahead turns the detectors of nodes; for commands that read the "
        "recording, convert --robot robot.param.yaml makes a bag with x ahead"
    ]


def check_recorded_poses(m: SensorMeasurement) -> list[str]:
    """Return the warnings about TF and odometry, which may contradict the clouds."""
    recorded, mount, heading = m.mounting.recorded, m.mounting.mount, m.mounting.heading
    warnings = []
    if recorded.left_out:
        warnings.append(
            f"{recorded.left_out} transforms or poses of the odometry are invalid (not "
            "finite, or no rotation) and were left out; check the node that publishes "
            "them"
        )
    if recorded.problem:
        warnings.append(
            f"the motion of the robot is measured from clouds alone: "
            f"{recorded.problem}; record odometry or TF all the time, with the base as "
            "child_frame_id and the clock of the clouds"
        )
    if mount is not None and recorded.mount is not None:
        tilt, error = np.degrees([mount.roll, mount.pitch]), np.degrees(mount.error[1:])
        difference = wrap_degrees(tilt - recorded.roll_pitch)
        if (np.abs(difference) > MAX_TILT_DIFFERENCE + 2 * error).any():
            warnings.append(
                f"TF has the sensor in '{recorded.base}' with roll "
                f"{recorded.roll_pitch[0]:.1f} and pitch {recorded.roll_pitch[1]:.1f} "
                f"deg, the ground shows {tilt[0]:.1f} and {tilt[1]:.1f}: correct the "
                "robot's description (URDF), which base_frame uses, or do not use "
                "base_frame"
            )
    if mount is not None and (abs(mount.height - recorded.height) > MAX_HEIGHT_DIFFERENCE_M + 2 * mount.error[0]):
        warnings.append(
            f"TF has the sensor {recorded.height:.2f} m above '{FOOTPRINT}', but it is "
            f"{mount.height:.2f} m above the ground: correct the URDF, which "
            "base_frame uses"
        )
    if heading is not None and not heading.problem and recorded.mount is not None:
        difference = wrap_degrees(heading.degrees - recorded.heading)
        if abs(difference) - 2 * heading.error > MAX_OFF_AXIS:
            warnings.append(
                f"by TF, x of '{recorded.base}' points {recorded.heading:.0f} deg from "
                "the clouds' x axis, but the robot drives towards "
                f"{heading.degrees:.0f}: correct the yaw in the URDF"
                + ("" if heading.from_base else ", unless the robot drove in another direction")
            )
    return warnings


def _check_columns(m: SensorMeasurement) -> list[str]:
    warnings = []
    if m.intensity is None:
        warnings.append(
            "there is no intensity, or it is constant: detectors that were trained "
            "with it lose accuracy; turn it on in the driver, or train with --sensor "
            "sensor.yaml, which has none either (silent: 1)"
        )
    elif not m.intensity.sure:
        warnings.append(
            f"intensities end at {m.intensity.greatest:g}, so the full scale "
            f"({m.intensity.full:g}) is a guess: no retroreflector was in view, or the "
            "driver has another scale; look it up and set input.intensity_max"
        )
    scan = m.source.scans[0]
    times = scan.seconds
    if times is not None and np.nanmax(times) - np.nanmin(times) < MIN_TURN_S:
        warnings.append(
            f"the times of the points span {1000 * np.ptp(times):.1f} ms, which is no "
            "turn: they have another meaning or unit; do not correct motion by them"
        )
    if scan.time_problem:
        warnings.append(f"{scan.time_problem}; motion is not corrected by such a column")
    return warnings


def _check_timing(m: SensorMeasurement) -> list[str]:
    warnings = []
    if not np.isfinite(m.timing.rate):
        warnings.append("the rate is unknown without stamps or times; set rate in sensor.yaml")
    if m.timing.missing > MAX_MISSING_SHARE * m.source.total:
        warnings.append(
            f"{m.timing.missing} clouds are missing between the stamps: the recorder "
            "or the network lost them; see docs/explanation/reliability.md"
        )
    if m.timing.backwards:
        warnings.append(
            f"{m.timing.backwards} stamps are not after the previous one: two sources "
            "share the topic, or clocks jump; synchronise the sensor's clock"
        )
    return warnings


def _check_view(m: SensorMeasurement) -> list[str]:
    warnings = []
    if m.view.max_range < MIN_OUTDOOR_RANGE_M:
        warnings.append(
            f"nothing is farther than {m.view.max_range:.0f} m: the room limits the "
            "range, not the sensor; max_range in sensor.yaml is "
            + ("that of the model" if m.pattern.model else "a guess")
        )
    coverage = m.view.coverage
    if coverage.has_walls:
        warnings.append(
            "more is constant around the robot than a body, such as walls and ceilings "
            "along its path, so no crop.body and no sector hidden by it is set; record "
            "a drive through an open place, or set crop.body by hand"
        )
    elif len(coverage.box) and not coverage.can_crop:
        warnings.append(
            f"{100 * coverage.foreign_share:.0f} % of the points in the box around the "
            "robot's own returns are not its own, so no crop.body and no sector hidden "
            "by it is set; set crop.body by hand"
        )
    if m.pattern.second_returns > MAX_SECOND_RETURNS:
        warnings.append(
            f"{100 * m.pattern.second_returns:.0f} % of the points share their "
            "direction with another, as second returns do; turn them off unless the "
            "detectors must see through dust or glass"
        )
    return warnings
