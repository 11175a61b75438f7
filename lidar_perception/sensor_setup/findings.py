"""What was measured, in words: a table of values with how sure each is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.intensity import INTENSITY_FIELDS
from lidar_perception.sensor_setup.coverage import ALWAYS, ARM
from lidar_perception.sensor_setup.doubts import SHORTEST_TURN, SLOPE, looks_elsewhere, told_doubts
from lidar_perception.sensor_setup.measure import FEW_SCANS, SMALL_ROOM, Measured
from lidar_perception.sensor_setup.scans import RINGS
from lidar_perception.sensor_setup.told import FOOTPRINT
from lidar_perception.wire.point_times import NAMES as TIMES

SURE, FAIR, DOUBTFUL = "sure", "fair", "doubtful"


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
                       "range" + (f", within {ARM:g} m: farther ones are those of walls, too"
                                  if m.coverage.walls else "" if m.coverage.still is False else
                                  f", within {ARM:g} m: the robot is not known to move"),
                       FAIR if m.coverage.still is False and not few and (
                           m.coverage.fits or not len(m.coverage.box)) else DOUBTFUL))
    out.append(Finding("range", f"{m.least:.2f} to {m.greatest:.1f} m", "of what is not the body",
                       FAIR if m.greatest > SMALL_ROOM else DOUBTFUL))
    out += _columns(m)
    out += [*_mount(m), _heading(m), *_told(m)]
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
    sure = SURE if len(m.scans) >= FEW_SCANS and np.degrees(q.spread[1:]).max() < SLOPE and (
        not m.coverage.still and not m.moved) else FAIR  # of one place it is that of its ground
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
    by = f"how what stands around shifts in {h.pairs} pairs of clouds"
    what = (f"where x of '{m.told.base}' looks, by its motion and {by}" if h.base else
            "where the robot drives, by " + ("the sensor's odometry" if m.told.poses and
                                             not m.told.base else by))
    return Finding("ahead", f"{h.degrees:z.0f} +- {h.error:.0f} deg from x", what,
                   DOUBTFUL if looks_elsewhere(h) else FAIR)


def _told(m: Measured) -> list[Finding]:
    if m.told.mount is None:
        return []
    roll, pitch = m.told.roll_pitch
    return [Finding("mount by TF", f"roll {roll:z.2f}, pitch {pitch:z.2f}, ahead "
                    f"{m.told.ahead:z.0f} deg from x", f"the bag's transforms, in '{m.told.base}', "
                    f"at {_three(m.told.mount[:3, 3])} m" + (
                        "" if np.isnan(m.told.height) else
                        f"; {m.told.height:.3f} m above '{FOOTPRINT}'"),
                    DOUBTFUL if told_doubts(m) else SURE)]


def _three(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in values) + ")"
