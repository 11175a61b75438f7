"""Warnings about a measurement, each in one line with the remedy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lidar_perception.sensor_setup.measurement.coverage import MIN_FAR_M
from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.sensor_setup.measurement.motion import MAX_OFF_AXIS, wrap_degrees
from lidar_perception.sensor_setup.measurement.recorded_poses import FOOTPRINT
from lidar_perception.simulation.sensor import find_sensor

MAX_SLOPE_SPREAD = 1.0  # maximum variation of the slope of level ground between scans, in degrees
MAX_HEIGHT_M = 5.0  # maximum plausible height of a sensor
MAX_TILT = 6.0  # maximum roll or pitch in degrees if all clouds are from one place; a larger one may be a slope
MAX_TILT_DIFFERENCE = 2.0  # tolerance between TF and ground in degrees, in addition to the error, for road camber
MAX_HEIGHT_DIFFERENCE_M = 0.1  # tolerance between the ground and TF or --height-hint
MAX_MISSING_FRACTION = 0.01  # maximum fraction of missing clouds
MIN_GROUND_FRACTION = 0.9  # minimum fraction of scans with ground
MIN_REVOLUTION_S = 0.02  # minimum time span of the points of one revolution
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


def _check_motion(m: SensorMeasurement) -> Iterator[str]:
    if len(m.source.scans) == 1:
        yield (
            "only one cloud: the robot's body, blind sectors and lost clouds cannot be measured; "
            "record a few minutes of driving"
        )
    elif m.view.coverage.stationary:
        yield "the robot stands still: its body cannot be distinguished from its surroundings; record while it drives"
    elif m.view.coverage.stationary is None:
        yield (
            f"cannot tell whether the robot moved: too few directions have returns beyond {MIN_FAR_M:.0f} m "
            "in most clouds; record a drive in an open place"
        )
    if len(m.source.frame_ids) > 1:
        yield (
            f"the topic has clouds in several frames ({', '.join(m.source.frame_ids)}), probably from several "
            "sensors; record each sensor on its own topic"
        )


def _check_beams(m: SensorMeasurement) -> Iterator[str]:
    pattern, beams = m.pattern, m.pattern.beams
    if beams is None:
        yield (
            "no beams found: the scan pattern does not repeat, clouds were merged or motion-corrected, or their "
            "frame is rotated relative to the sensor; sensor.yaml describes a grid with the same field of view; "
            "record the driver's own cloud if possible"
        )
        return
    if pattern.model and len(beams.elevations) < (rings := find_sensor(pattern.model).rings):
        yield (
            f"only {len(beams.elevations)} of the {rings} beams of {pattern.model} have returns: sensor.yaml lists "
            "all beams of the model; to measure them, record where every beam hits something"
        )
    if pattern.is_moved:
        yield (
            f"points of a beam scatter by {np.median(beams.spread):.2f} deg: the clouds are motion-corrected or not "
            "in the sensor's frame, so the height is that of the frame and steep beams are less accurate"
            + (f"; sensor.yaml has the beams of {pattern.model}" if pattern.prefers_model else "")
            + "; record the driver's own cloud"
        )
    elif beams.lifts.any() and m.source.has_few_scans:
        yield (
            "the beams start at different heights, which cannot be measured well from so few scans; record more clouds"
        )


def _check_mount(m: SensorMeasurement) -> Iterator[str]:
    mount, scans = m.mounting.mount, m.source.scans
    if m.mounting.on_ground:
        yield (
            "the clouds are in a frame on the ground, such as base_footprint: height, roll and pitch of the sensor "
            "are unknown; use the driver's own cloud"
        )
        return
    if mount is None:
        yield (
            "no ground in view: height, roll and pitch are unknown; record where a few metres of floor around the "
            "robot are visible, or set ground.sensor_pose by hand"
        )
        return
    if mount.height > MAX_HEIGHT_M:
        yield (
            f"the detected ground is {mount.height:.1f} m away: it may be a wall, if the sensor is mounted on its "
            "side; set ground.sensor_pose by hand"
        )
    hint = m.mounting.height_hint
    if hint is not None and abs(mount.height - hint) >= MAX_HEIGHT_DIFFERENCE_M:
        yield (
            f"the sensor is {mount.height:.2f} m above the ground, but --height-hint is {hint:g}; measure the "
            "height by hand"
        )
    if mount.upside_down:
        yield (
            "the sensor is mounted upside down (see ground.sensor_pose.roll): the ground is on the side of its z "
            "axis; if only the driver's frame has z down, rotate that frame instead"
        )
    ground_count = sum(plane is not None for plane in mount.planes)
    if ground_count < MIN_GROUND_FRACTION * len(scans):
        yield (
            f"ground was found in only {ground_count} of {len(scans)} scans; record where the floor around the "
            "robot is free"
        )
    slope_spread = np.degrees(mount.spread[1:]).max()
    if slope_spread > MAX_SLOPE_SPREAD:
        yield (
            f"the slope of the ground varies by {slope_spread:.1f} deg between scans: hills, curves or a swaying "
            "robot; record on level ground, or longer"
        )
    if not mount.is_level:
        yield (
            "simulate and train assume a level sensor: sensor.yaml has no tilt, and only blind sectors outside the "
            "field of view; nodes and convert --robot level the clouds with robot.param.yaml"
        )
    tilt = np.degrees([np.arctan2(np.sin(mount.roll), abs(np.cos(mount.roll))), mount.pitch])
    if np.abs(tilt).max() > MAX_TILT and (m.source.has_few_scans or m.view.coverage.stationary):
        yield (
            f"the sensor is tilted by {np.abs(tilt).max():.0f} deg relative to the ground, because of its mount or "
            "of a slope; record in several places"
        )


def _check_heading(m: SensorMeasurement) -> Iterator[str]:
    heading = m.mounting.heading
    if heading is None or len(m.source.scans) == 1:
        return  # missing ground or motion has its own warning
    direction = (
        f"the robot drives towards {heading.degrees:.0f} deg from the cloud's x axis, which detectors take as forward"
    )
    if heading.problem:
        yield (
            f"yaw unknown: {heading.problem}; record while the robot drives a few metres straight ahead, or check "
            "that x of the clouds points forward"
        )
    elif heading.is_off_axis and heading.may_be_reversed:
        yield (
            f"{direction}: the robot drove backwards, or the frame is rotated about z; if it is rotated, set "
            f"input.ahead to {heading.degrees:.0f}"
        )
    elif heading.is_off_axis:
        yield (
            f"{direction}: input.ahead corrects this in the nodes; for commands that read the recording, make a bag "
            "whose x axis points forward: convert --robot robot.param.yaml"
        )


def check_recorded_poses(m: SensorMeasurement) -> Iterator[str]:
    """Yield warnings about invalid TF and odometry, and about contradictions to the clouds."""
    recorded, mount, heading = m.mounting.recorded, m.mounting.mount, m.mounting.heading
    if recorded.invalid_count:
        yield (
            f"ignored {recorded.invalid_count} transforms or odometry poses that are not finite or not rotations; "
            "check the node that publishes them"
        )
    if recorded.problem:
        yield (
            f"the motion of the robot is measured only from clouds: {recorded.problem}; record odometry or TF "
            "during the whole drive, with the base as child_frame_id and the same clock as the clouds"
        )
    if mount is not None and recorded.mount is not None:
        tilt, error = np.degrees([mount.roll, mount.pitch]), np.degrees(mount.error[1:])
        if (np.abs(wrap_degrees(tilt - recorded.roll_pitch)) > MAX_TILT_DIFFERENCE + 2 * error).any():
            yield (
                f"by TF, the sensor in '{recorded.base}' has roll {recorded.roll_pitch[0]:.1f} and pitch "
                f"{recorded.roll_pitch[1]:.1f} deg, but the ground shows {tilt[0]:.1f} and {tilt[1]:.1f}; correct "
                "the URDF, which base_frame uses, or do not set base_frame"
            )
    if mount is not None and abs(mount.height - recorded.height) > MAX_HEIGHT_DIFFERENCE_M + 2 * mount.error[0]:
        yield (
            f"by TF, the sensor is {recorded.height:.2f} m above '{FOOTPRINT}', but it is {mount.height:.2f} m above "
            "the ground; correct the URDF, which base_frame uses"
        )
    if heading is not None and not heading.problem and recorded.mount is not None:
        if abs(wrap_degrees(heading.degrees - recorded.heading)) - 2 * heading.error > MAX_OFF_AXIS:
            yield (
                f"by TF, x of '{recorded.base}' points {recorded.heading:.0f} deg from the clouds' x axis, but the "
                f"robot drives towards {heading.degrees:.0f}; correct the yaw in the URDF"
                + ("" if heading.from_base else ", unless the robot drove sideways or backwards")
            )


def _check_columns(m: SensorMeasurement) -> Iterator[str]:
    if m.intensity is None:
        yield (
            "the clouds have no intensity, or it is constant: detectors trained with intensity lose accuracy; turn it "
            "on in the driver, or train with --sensor sensor.yaml, which also has no intensity (silent: 1)"
        )
    elif not m.intensity.is_certain:
        yield (
            f"the full scale of the intensity ({m.intensity.full_scale:g}) is a guess: the highest value is "
            f"{m.intensity.maximum:g}, because no retroreflector was in view or the driver has another scale; look "
            "it up in the manual and set input.intensity_max"
        )
    scan = m.source.scans[0]
    times = scan.seconds
    if times is not None and np.nanmax(times) - np.nanmin(times) < MIN_REVOLUTION_S:
        yield (
            f"the times of the points span only {1000 * np.ptp(times):.1f} ms, less than a revolution: they have "
            "another meaning or unit; do not use them for motion correction"
        )
    if scan.time_problem:
        yield f"{scan.time_problem}; motion correction cannot use this column"


def _check_timing(m: SensorMeasurement) -> Iterator[str]:
    if not np.isfinite(m.timing.rate):
        yield "the rate is unknown: the clouds have neither stamps nor point times; set rate in sensor.yaml"
    if m.timing.missing_count > MAX_MISSING_FRACTION * m.source.total:
        yield (
            f"{m.timing.missing_count} clouds are missing between the stamps: the recorder or the network lost them; "
            "see docs/explanation/reliability.md"
        )
    if m.timing.backward_count:
        yield (
            f"{m.timing.backward_count} stamps are not later than the previous one: the topic has two publishers, or "
            "the clock jumps; synchronise the sensor's clock"
        )


def _check_view(m: SensorMeasurement) -> Iterator[str]:
    coverage = m.view.coverage
    if m.view.max_range < MIN_OUTDOOR_RANGE_M:
        yield (
            f"no return is farther than {m.view.max_range:.0f} m: the room limits the range, not the sensor; "
            "max_range in sensor.yaml is " + ("the value of the model" if m.pattern.model else "a guess")
        )
    if coverage.has_walls:
        yield (
            "constant surroundings, such as walls along the path, cannot be distinguished from the robot's body: "
            "crop.body and the sectors hidden by the body are not set; record a drive in an open place, or set "
            "crop.body by hand"
        )
    elif len(coverage.box) and not coverage.can_crop:
        yield (
            f"{100 * coverage.foreign_fraction:.0f} % of the points in the box around the robot's body are not returns "
            "of the robot: crop.body and the sectors hidden by the body are not set; set crop.body by hand"
        )
    if m.pattern.second_returns > MAX_SECOND_RETURNS:
        yield (
            f"{100 * m.pattern.second_returns:.0f} % of the points share their direction with another point, like "
            "second returns; turn them off in the driver, unless detectors must see through dust or glass"
        )
