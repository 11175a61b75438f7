"""What was measured, in words: a table of values with how sure each is, and what is doubtful with
the remedy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.sensor_setup.coverage import ALWAYS, ARM
from lidar_perception.sensor_setup.measure import FEW_SCANS, SMALL_ROOM, Measured
from lidar_perception.sensor_setup.scans import RINGS
from lidar_perception.simulation.sensor import sensor_named
from lidar_perception.wire.messages import INTENSITY_FIELDS
from lidar_perception.wire.point_times import NAMES as TIMES

SURE, FAIR, DOUBTFUL = "sure", "fair", "doubtful"
SLOPE = 1.0         # degrees by which the ground leans from scan to scan, from which on it slopes
STEEP_MOUNT = 6.0   # degrees of roll or pitch: either mounted so, or all of it on a slope
NOT_AHEAD = 10.0    # degrees between x and where the robot drives, beyond twice the error
MANY_LOST = 0.01    # share of missing clouds
SHORTEST_TURN = 0.02  # s; times that span less are no turn
MAX_OTHERS = 0.2    # share of other points in the box of the robot's body


class Finding(NamedTuple):
    """A measured value: what, the value, how it was measured, and SURE, FAIR or DOUBTFUL."""

    what: str
    value: str
    how: str
    sure: str


def findings(m: Measured) -> list[Finding]:
    """Every value that was measured."""
    few = len(m.scans) < FEW_SCANS
    scans = f"{len(m.scans)} scan{'s' * (len(m.scans) != 1)}"
    out = []
    if m.beams is not None:
        up = m.beams.elevations
        how = {"ring": "by the ring column", "order": "by the order of the points",
               "elevation": "by peaks of the elevations"}[m.beams.how]
        error = max(float(m.beams.error.max()), float(np.median(m.beams.spread)))
        how_sure = DOUBTFUL if error > 0.3 else FAIR if error > 0.05 or m.moved else SURE
        out.append(Finding("beams", f"{len(up)}, {up[-1]:.2f} to {up[0]:.2f} deg", f"{how}, "
                           f"{scans}; error up to {m.beams.error.max():.3f} deg, points of a beam "
                           f"within {np.median(m.beams.spread):.3f} deg", how_sure))
        out.append(Finding("model", m.model or "none of config/sensors", "beams within "
                           f"{m.model_error:.3f} deg of its own" if m.model else
                           "no model has such beams", SURE if m.model else FAIR))
        out.append(Finding("azimuth step", f"{m.step:.4f} deg, {360 / m.step:.0f} in a turn",
                           "mean distance of neighbours in a beam", SURE))
        out.append(Finding("range noise", f"{100 * m.noise:.1f} cm", "about smooth surfaces, "
                           f"{m.noise_pieces} pieces of 9 returns of a beam",
                           FAIR if m.noise_pieces > 500 else DOUBTFUL))
    else:
        up = np.percentile(np.concatenate([s.elevation for s in m.scans]), [0.2, 99.8])
        out.append(Finding("beams", f"none, {up[0]:.1f} to {up[1]:.1f} deg",
                           "points lie on no beams", FAIR))
    start, end = m.coverage.view
    out.append(Finding("field of view", "360 deg" if (start, end) == (0.0, 360.0) else
                       f"{(end - start) % 360:.0f} deg, from {start:.0f} to {end:.0f}",
                       f"azimuths with returns, {scans}", DOUBTFUL if few else SURE))
    hidden = sum((b - a) % 360 or 360 for _, a, b in m.coverage.blocked)
    out.append(Finding("blind sectors", f"{len(m.coverage.blocked)}, {hidden:.0f} deg together",
                       "where lower beams never have a return", DOUBTFUL if few else FAIR))
    out.append(Finding("body", "none seen" if not len(m.coverage.box) else
                       f"{100 * m.coverage.body_share:.1f} % of the points, from "
                       f"{_three(m.coverage.box[:3])} to {_three(m.coverage.box[3:])} m",
                       f"returns that are there in {100 * ALWAYS:.0f} % of the scans at the same "
                       "range" + ("" if m.coverage.still is False else
                                  f", within {ARM:g} m: the robot is not known to move"),
                       FAIR if m.coverage.still is False and not few else DOUBTFUL))
    out.append(Finding("range", f"{m.least:.2f} to {m.greatest:.1f} m", "of what is not the body",
                       FAIR if m.greatest > SMALL_ROOM else DOUBTFUL))
    out += _columns(m)
    out += [*_mount(m), _heading(m)]
    t = m.timing
    out.append(Finding("rate", "not known" if np.isnan(t.rate) else
                       f"{t.rate:.2f} turns a second", f"from {t.by}",
                       {"stamps": SURE, "nothing": DOUBTFUL}.get(t.by, FAIR)))
    if t.turns and m.beams is not None and m.beams.how != "order":
        out.append(Finding("turns", t.turns, "by the points' " + (
            "times" if m.scans[0].seconds is not None else "order"), FAIR))
    if t.by == "stamps":
        out.append(Finding("losses", f"{t.missing} clouds in {t.gaps} gaps", f"of the stamps of "
                           f"{m.total} clouds; they jitter by {1000 * t.jitter:.1f} ms", SURE))
    frames = sorted({scan.frame_id for scan in m.scans} - {""})
    out.append(Finding("frame", ", ".join(frames) or "none", "header.frame_id",
                       SURE if len(frames) == 1 else DOUBTFUL))
    return out


def _columns(m: Measured) -> list[Finding]:
    scan = m.scans[0]
    named = {"intensity": next((n for n in INTENSITY_FIELDS if n in scan.columns), ""),
             "ring": next((n for n in RINGS if n in scan.columns), ""),
             "time": next((n for n in TIMES if n in scan.columns), "")}
    others = [c for c in scan.columns if c not in ("x", "y", "z", *named.values())]
    out = [Finding("columns", ", ".join(scan.columns), "; ".join(
        f"{what}: {name}" if name else f"no {what}" for what, name in named.items())
        + (f"; not used: {', '.join(others)}" if others else ""), SURE)]
    i = m.intensity
    if i is not None:
        kind = " in whole numbers" if i.whole else ""
        out.append(Finding("intensity", f"0 to {i.full:g}{kind}",
                           f"up to {i.greatest:.4g}; 0 for {100 * i.zeros:.1f} %, median "
                           f"{i.quantiles[50]:.3g}, {100 * i.bright:.2f} % as bright as "
                           "retroreflectors", SURE if i.sure else DOUBTFUL))
    if scan.seconds is not None:
        low, high = float(np.nanmin(scan.seconds)), float(np.nanmax(scan.seconds))
        out.append(Finding("time of points", f"{1000 * low:.1f} to {1000 * high:.1f} ms",
                           f"column '{named['time']}', after header.stamp",
                           SURE if high - low > SHORTEST_TURN else DOUBTFUL))
    return out


def _mount(m: Measured) -> list[Finding]:
    if m.mount is None:
        return [Finding("height", "not known", "no ground in sight", DOUBTFUL)]
    q, found = m.mount, sum(p is not None for p in m.mount.planes)
    how = f"plane through the ground around, {found} of {len(m.scans)} scans"
    degrees = np.degrees(q.error)
    sure = SURE if len(m.scans) >= FEW_SCANS and np.degrees(q.spread[1:]).max() < SLOPE else FAIR
    return [Finding("height", f"{q.height:.3f} +- {q.error[0]:.3f} m",
                    f"{how}; from scan to scan {q.spread[0]:.3f} m", sure),
            Finding("roll", f"{np.degrees(q.roll):.2f} +- {degrees[1]:.2f} deg",
                    f"{how}; from scan to scan {np.degrees(q.spread[1]):.2f} deg", sure),
            Finding("pitch", f"{np.degrees(q.pitch):.2f} +- {degrees[2]:.2f} deg",
                    f"{how}; from scan to scan {np.degrees(q.spread[2]):.2f} deg", sure)]


def _heading(m: Measured) -> Finding:
    h = m.heading
    if h is None or h.unknown:
        return Finding("ahead", "not known", h.unknown if h else "no ground in sight", DOUBTFUL)
    return Finding("ahead", f"{h.degrees:.0f} +- {h.error:.0f} deg from x", "where the robot "
                   f"drives, by how what stands around shifts in {h.pairs} pairs of clouds",
                   FAIR if abs(h.degrees) - 2 * h.error <= NOT_AHEAD else DOUBTFUL)


def _three(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in values) + ")"


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
        out.append("whether the robot moved cannot be told, as too few returns are farther than "
                   "4 m; record while it drives through an open place")
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
    out += _heading_doubts(m)
    if m.intensity is None:
        out.append("there is no intensity, or always the same: detectors that were trained with it "
                   "lose accuracy; turn it on in the driver, or train with --augment-intensity")
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
                   "network lost them; see docs/reliability.md")
    if m.timing.backwards:
        out.append(f"{m.timing.backwards} stamps are not after the one before: two sources share "
                   "the topic, or clocks jump; synchronise the sensor's clock")
    if m.greatest < SMALL_ROOM:
        out.append(f"nothing is farther than {m.greatest:.0f} m: this is the room, not the "
                   "sensor's range; max_range in sensor.yaml is "
                   + ("that of the model" if m.model else "a guess"))
    c = m.coverage
    if len(c.box) and not body_fits(m):
        out.append(f"{100 * c.others:.0f} % of the points in the box around the robot's own "
                   "returns are not its own, so no crop.body is set; set one by hand by the report")
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
                   f"{m.model} were seen: record where all of them meet something, or take "
                   f"elevations from config/sensors/{m.model}.yaml")
    if m.moved:
        out.append(f"points of a beam scatter by {np.median(beams.spread):.2f} deg: the clouds are "
                   "corrected for motion, or in a frame that is not the sensor's, and steep beams "
                   "are less sure" + (f", so that sensor.yaml has those of {m.model}"
                                      if m.as_model else "") + "; record the driver's own cloud")
    elif beams.lifts.any() and len(m.scans) < FEW_SCANS:
        out.append("the beams start at different heights, which a few scans do not tell well; "
                   "record more")
    return out


def _mount_doubts(m: Measured) -> list[str]:
    if m.mount is None:
        return ["no ground in sight, so that height, roll and pitch are not known; record where "
                "the floor is seen for some metres around, or set ground.sensor_pose by hand"]
    out, q = [], m.mount
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
    if abs(h.degrees) - 2 * h.error <= NOT_AHEAD:
        return []
    back = ", unless it was driven backwards" if abs(h.degrees) > 180 - 2 * NOT_AHEAD else ""
    return [f"the robot drives towards {h.degrees:.0f} deg of the cloud's x axis, which should "
            f"look ahead: the frame is turned about z{back}; turn the clouds by "
            f"{-h.degrees:.0f} deg in the driver (base_frame does not turn them), or use detectors "
            "that look all around (train --range around)"]


def body_fits(m: Measured) -> bool:
    """Whether the box around the robot's own returns can be left out: few other points are in it,
    or none of it is farther than an arm."""
    box = m.coverage.box
    return len(box) > 0 and (m.coverage.others <= MAX_OTHERS or float(np.abs(box).max()) < ARM)
