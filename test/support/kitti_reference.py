"""Independent plain implementation of KITTI's object benchmark, for comparison: label files in, percent out. It
uses slow loops over lines of text in camera coordinates (x right, y down, z forward) and shares no code with the
package. It also generates random frames for the comparison.
"""

from __future__ import annotations

import math

import numpy as np

LIMITS = {"easy": (40, 0, 0.15), "moderate": (25, 1, 0.30), "hard": (25, 2, 0.50)}
NAMES = ("kind truncated occluded alpha left top right bottom h w l x y z ry score").split()


def read(text):
    """Return one dict per line."""
    rows = []
    for line in text.splitlines():
        words = line.split()
        rows.append({name: word if name == "kind" else float(word) for name, word in zip(NAMES, words)})
    return rows


def footprint(o):
    """Return the corners in the x-z plane, in order."""
    c, s = math.cos(o["ry"]), math.sin(o["ry"])
    return [
        (o["x"] + c * a + s * b, o["z"] - s * a + c * b)
        for a, b in (
            (o["l"] / 2, o["w"] / 2),
            (-o["l"] / 2, o["w"] / 2),
            (-o["l"] / 2, -o["w"] / 2),
            (o["l"] / 2, -o["w"] / 2),
        )
    ]


def inside(p, o):
    dx, dz = p[0] - o["x"], p[1] - o["z"]
    c, s = math.cos(o["ry"]), math.sin(o["ry"])
    return abs(c * dx - s * dz) <= o["l"] / 2 + 1e-12 and abs(s * dx + c * dz) <= o["w"] / 2 + 1e-12


def crossing(p, q, r, s):
    d = (q[0] - p[0]) * (s[1] - r[1]) - (q[1] - p[1]) * (s[0] - r[0])
    if abs(d) < 1e-14:
        return None
    t = ((r[0] - p[0]) * (s[1] - r[1]) - (r[1] - p[1]) * (s[0] - r[0])) / d
    u = ((r[0] - p[0]) * (q[1] - p[1]) - (r[1] - p[1]) * (q[0] - p[0])) / d
    if 0 <= t <= 1 and 0 <= u <= 1:
        return p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])


def shared_ground(a, b):
    """Return the overlap area. Its corners are corners of one box inside the other and crossings of edges, sorted
    by angle around their centre."""
    if math.hypot(a["x"] - b["x"], a["z"] - b["z"]) > (a["l"] + a["w"] + b["l"] + b["w"]) / 2:
        return 0.0
    pa, pb = footprint(a), footprint(b)
    points = [p for p in pa if inside(p, b)] + [p for p in pb if inside(p, a)]
    for i in range(4):
        for j in range(4):
            p = crossing(pa[i], pa[(i + 1) % 4], pb[j], pb[(j + 1) % 4])
            if p:
                points.append(p)
    if len(points) < 3:
        return 0.0
    mx, mz = (sum(p[k] for p in points) / len(points) for k in (0, 1))
    points.sort(key=lambda p: math.atan2(p[1] - mz, p[0] - mx))
    return abs(sum(p[0] * q[1] - q[0] * p[1] for p, q in zip(points, points[1:] + points[:1]))) / 2


def shared_pixels(a, b):
    width = min(a["right"], b["right"]) - max(a["left"], b["left"])
    height = min(a["bottom"], b["bottom"]) - max(a["top"], b["top"])
    return width * height if width > 0 and height > 0 else 0.0


def pixels(a):
    return (a["right"] - a["left"]) * (a["bottom"] - a["top"])


def overlap(a, b, metric):
    if metric == "image":
        shared, total = shared_pixels(a, b), pixels(a) + pixels(b)
    else:
        shared, total = shared_ground(a, b), a["l"] * a["w"] + b["l"] * b["w"]
    if metric == "3d":
        shared *= max(0.0, min(a["y"], b["y"]) - max(a["y"] - a["h"], b["y"] - b["h"]))
        total = a["l"] * a["w"] * a["h"] + b["l"] * b["w"] * b["h"]
    return shared / (total - shared) if shared > 0 else 0.0


def role_of_truth(o, kind, level):
    """Return 'find', 'may find' or None."""
    height, occluded, truncated = LIMITS[level]
    if o["kind"] == kind:
        easy_enough = o["bottom"] - o["top"] >= height and o["occluded"] <= occluded and o["truncated"] <= truncated
        return "find" if easy_enough else "may find"
    if (kind, o["kind"]) in (("Car", "Van"), ("Pedestrian", "Person_sitting")):
        return "may find"
    return None


def role_of_detection(d, kind, level):
    """Return 'judge', 'may be used' (for detections of any class below the minimum height) or None."""
    if d["bottom"] - d["top"] < LIMITS[level][0]:
        return "may be used"
    return "judge" if d["kind"] == kind else None


def by_falling_score(detections):
    return sorted(detections, key=lambda d: -d["score"])


def prepare(frames, metric):
    """Convert (label text, result text) to (truth, found, overlaps {(found, true): value})."""
    prepared = []
    for labels, results in frames:
        truth, found = read(labels), by_falling_score(read(results))
        table = {
            (j, i): overlap(d, o, metric)
            for j, d in enumerate(found)
            for i, o in enumerate(truth)
            if o["kind"] != "DontCare"
        }
        prepared.append((truth, found, table))
    return prepared


def first_pass(prepared, kind, level, least):
    """Return the number of objects to find, and the scores of their detections."""
    objects, scores = 0, []
    for truth, found, table in prepared:
        used = set()
        for i, o in enumerate(truth):
            role = role_of_truth(o, kind, level)
            objects += role == "find"
            if role is None:
                continue
            fitting = [
                j
                for j, d in enumerate(found)
                if j not in used and role_of_detection(d, kind, level) and table[j, i] > least
            ]
            if fitting:
                j = max(fitting, key=lambda j: found[j]["score"])
                used.add(j)
                if role == "find" and role_of_detection(found[j], kind, level) == "judge":
                    scores.append(found[j]["score"])
    return objects, sorted(scores, reverse=True)


def second_pass(prepared, kind, level, least, metric, threshold):
    """Return precision and orientation similarity of detections with at least this score."""
    right = wrong = similarity = 0
    for truth, found, table in prepared:
        accepted = [j for j, d in enumerate(found) if d["score"] >= threshold]
        used = set()
        for i, o in enumerate(truth):
            role = role_of_truth(o, kind, level)
            if role is None:
                continue
            fitting = {"judge": [], "may be used": [], None: []}
            for j in accepted:
                if j not in used and table[j, i] > least:
                    fitting[role_of_detection(found[j], kind, level)].append(j)
            if fitting["judge"]:
                j = max(fitting["judge"], key=lambda j: table[j, i])
            elif fitting["may be used"]:
                j = fitting["may be used"][0]
            else:
                continue
            used.add(j)
            if role == "find" and role_of_detection(found[j], kind, level) == "judge":
                right += 1
                similarity += (1 + math.cos(o["alpha"] - found[j]["alpha"])) / 2
        for j in accepted:
            if role_of_detection(found[j], kind, level) != "judge" or j in used:
                continue
            if metric == "image" and any(
                shared_pixels(found[j], o) / pixels(found[j]) > least for o in truth if o["kind"] == "DontCare"
            ):
                continue
            wrong += 1
    if right + wrong == 0:
        return 0.0, 0.0
    return right / (right + wrong), similarity / (right + wrong)


def sampled(scores, objects):
    """Return the scores nearest to recalls 0, 1/40, ..., 1."""
    thresholds, wanted = [], 0.0
    for i, score in enumerate(scores, 1):
        last = i == len(scores)
        if last or not (i + 1) / objects - wanted < wanted - i / objects:
            thresholds.append(score)
            wanted += 1 / 40
    return thresholds


def averages(values):
    """Return the average of the envelope of 41 values, at 11 and at 40 points."""
    values = [max(values[k:]) for k in range(41)]
    return 100 * sum(values[0::4]) / 11, 100 * sum(values[1:]) / 40


def evaluate(prepared, kind, level, least, metric):
    """Return objects, r11, r40, aos_r11, aos_r40; None without objects."""
    objects, scores = first_pass(prepared, kind, level, least)
    if objects == 0:
        return None

    def at(threshold):
        return second_pass(prepared, kind, level, least, metric, threshold)

    if objects > 40:
        points = [at(t) for t in sampled(scores, objects)]
        points += [(0.0, 0.0)] * (41 - len(points))
    else:  # for each recall k / 40, the best of all scores that reach it
        reached = [(n / objects, *at(score)) for n, score in enumerate(scores, 1)]
        points = []
        for k in range(41):
            enough = [row for row in reached if row[0] >= k / 40 - 1e-9]
            points.append((max((row[1] for row in enough), default=0.0), max((row[2] for row in enough), default=0.0)))
    return objects, *averages([p for p, _ in points]), *averages([s for _, s in points])


SIZES = {
    "Car": (1.5, 1.6, 3.9),
    "Van": (2.2, 1.9, 5.0),
    "Pedestrian": (1.7, 0.6, 0.8),
    "Person_sitting": (1.3, 0.6, 0.8),
    "Cyclist": (1.7, 0.6, 1.8),
    "Truck": (3.2, 2.6, 10.0),
}


def some_object(rng):
    kind = rng.choice(list(SIZES), p=[0.35, 0.08, 0.22, 0.05, 0.25, 0.05])
    h, w, l = np.array(SIZES[kind]) * rng.uniform(0.9, 1.1, 3)  # noqa: E741
    o = dict(
        kind=str(kind),
        truncated=float(rng.choice([0, 0, 0, 0.2, 0.4, 0.7])),
        occluded=int(rng.choice([0, 0, 0, 1, 2, 3])),
        alpha=rng.uniform(-3.1, 3.1),
        h=h,
        w=w,
        l=l,
        x=rng.uniform(-12, 12),
        y=rng.uniform(1.4, 1.9),
        z=rng.uniform(6, 45),
        ry=rng.uniform(-3.1, 3.1),
    )
    return with_pixels(o)


def with_pixels(o):
    left, right = (621 + 720 * (o["x"] + s * o["w"]) / o["z"] for s in (-1, 1))
    top, bottom = (187 + 720 * v / o["z"] for v in (o["y"] - o["h"], o["y"]))
    return {**o, "left": left, "top": top, "right": right, "bottom": bottom}


def moved(o, rng, by):
    o = {
        **o,
        "alpha": o["alpha"] + rng.normal() * 3 * by,
        "ry": o["ry"] + rng.normal() * by,
        **{k: o[k] + rng.normal() * by for k in "xyz"},
        **{k: o[k] * (1 + rng.normal() * by / 2) for k in "hwl"},
    }
    if rng.random() < 0.15:
        o["kind"] = str(rng.choice(["Car", "Pedestrian", "Cyclist"]))
    return with_pixels(o)


def line(o, score=None):
    words = [o["kind"], f"{o['truncated']:.2f}", str(o["occluded"])]
    words += [f"{o[name]:.2f}" for name in NAMES[3:15]]
    return " ".join(words + ([] if score is None else [f"{score:.6f}"]))


def random_frame(rng, most=8, noise=0.12):
    """Return (label text, result text) with misses, duplicates, wrong classes, false boxes and DontCare."""
    truth = [some_object(rng) for _ in range(rng.integers(0, most + 1))]
    found = [moved(o, rng, noise * rng.uniform(0.1, 1.5)) for o in truth for _ in range(rng.choice([0, 1, 1, 1, 2]))]
    found += [some_object(rng) for _ in range(rng.integers(0, 4))]
    regions = [
        line(
            {
                **some_object(rng),
                "kind": "DontCare",
                "truncated": -1,
                "occluded": -1,
                "h": -1,
                "w": -1,
                "l": -1,
                "x": -1000,
                "y": -1000,
                "z": -1000,
            }
        )
        for _ in range(rng.integers(0, 3))
    ]
    labels = [line(o) for o in truth] + regions
    results = [line(d, score) for d, score in zip(found, rng.uniform(0, 1, len(found)))]
    return "\n".join(labels), "\n".join(results)
