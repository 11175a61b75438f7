"""Independent plain implementation of nuScenes' detection task, for comparison: table rows and result rows in,
scores out. Slow loops, no code of the package.
"""

from __future__ import annotations

import math

RANGE = {
    "car": 50,
    "truck": 50,
    "bus": 50,
    "trailer": 50,
    "construction_vehicle": 50,
    "pedestrian": 40,
    "motorcycle": 40,
    "bicycle": 40,
    "traffic_cone": 30,
    "barrier": 30,
}
WITHOUT = {"traffic_cone": {"orientation", "velocity", "attribute"}, "barrier": {"velocity", "attribute"}}
ERRORS = ("translation", "scale", "orientation", "velocity", "attribute")


def yaw(q):
    w, x, y, z = (v / math.sqrt(sum(u * u for u in q)) for v in q)
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def flat_distance(a, b):
    return math.hypot(a[0] - b[0], a[1] - b[1])


def velocity(label, labels, times):
    """Return the velocity in m/s, or None."""
    before, after = labels.get(label["prev"], label), labels.get(label["next"], label)
    seconds = (times[after["sample_token"]] - times[before["sample_token"]]) / 1e6
    allowed = 3.0 if label["prev"] and label["next"] else 1.5
    if before is after or seconds > allowed:
        return None
    return tuple((after["translation"][k] - before["translation"][k]) / seconds for k in (0, 1))


def in_rack(box, racks):
    for rack in racks:
        angle = yaw(rack["rotation"])
        dx, dy, dz = (box["translation"][k] - rack["translation"][k] for k in range(3))
        along = dx * math.cos(angle) + dy * math.sin(angle)
        across = dy * math.cos(angle) - dx * math.sin(angle)
        w, l, h = rack["size"]  # noqa: E741
        if abs(along) <= l / 2 and abs(across) <= w / 2 and abs(dz) <= h / 2:
            return True
    return False


def labels_by_sample(tables, classes):
    """Return {sample: (scored labels with class, velocity and attribute, racks, vehicle)}."""
    categories = {r["token"]: r["name"] for r in tables["category"]}
    of_instance = {r["token"]: categories[r["category_token"]] for r in tables["instance"]}
    attributes = {r["token"]: r["name"] for r in tables["attribute"]}
    times = {r["token"]: r["timestamp"] for r in tables["sample"]}
    labels = {r["token"]: r for r in tables["sample_annotation"]}
    poses = {r["token"]: r["translation"] for r in tables["ego_pose"]}
    samples = {}
    for data in tables["sample_data"]:
        if data["is_key_frame"] and "LIDAR_TOP" in data["filename"]:
            samples[data["sample_token"]] = ([], [], poses[data["ego_pose_token"]])
    for label in tables["sample_annotation"]:
        true, racks, _ = samples[label["sample_token"]]
        category = of_instance[label["instance_token"]]
        if category == "static_object.bicycle_rack":
            racks.append(label)
        elif category in classes and label["num_lidar_pts"] + label["num_radar_pts"] > 0:
            true.append(
                {
                    **label,
                    "name": classes[category],
                    "velocity": velocity(label, labels, times),
                    "attribute": next(map(attributes.get, label["attribute_tokens"]), None),
                }
            )
    return samples


def counts(box, name, racks, vehicle):
    return flat_distance(box["translation"], vehicle) < RANGE[name] and not (
        name in ("bicycle", "motorcycle") and in_rack(box, racks)
    )


def read_off(x, xs, ys):
    """Interpolate a rising curve linearly; of several points with equal x the last counts. Both ends are
    constant."""
    if x < xs[0]:
        return ys[0]
    i = max(k for k in range(len(xs)) if xs[k] <= x)
    if i + 1 == len(xs):
        return ys[i]
    return ys[i] + (ys[i + 1] - ys[i]) * (x - xs[i]) / (xs[i + 1] - xs[i])


def error(kind, true, found, name):
    """Return the error, or None if it is unknown."""
    if kind == "translation":
        return flat_distance(true["translation"], found["translation"])
    if kind == "scale":
        shared = math.prod(map(min, true["size"], found["size"]))
        return 1 - shared / (math.prod(true["size"]) + math.prod(found["size"]) - shared)
    if kind == "orientation":
        yaw_error = abs(yaw(true["rotation"]) - yaw(found["rotation"])) % (2 * math.pi)
        yaw_error = min(yaw_error, 2 * math.pi - yaw_error)
        return min(yaw_error, math.pi - yaw_error) if name == "barrier" else yaw_error
    if kind == "velocity":
        if true["velocity"] is None or any(math.isnan(v) for v in found["velocity"]):
            return None
        return flat_distance(true["velocity"], found["velocity"])
    return None if true["attribute"] is None else float(true["attribute"] != found["attribute_name"])


def of_class(samples, results, name, most):
    """Return AP and the five errors for one distance threshold."""
    left = {
        s: [b for b in true if b["name"] == name and counts(b, name, racks, vehicle)]
        for s, (true, racks, vehicle) in samples.items()
    }
    objects = sum(map(len, left.values()))
    found = [
        (s, b)
        for s, (_, racks, vehicle) in samples.items()
        for b in results[s]
        if b["detection_name"] == name and counts(b, name, racks, vehicle)
    ]
    found.sort(key=lambda item: -item[1]["detection_score"])
    recall, precision, scores, pairs = [], [], [], []
    for n, (sample, box) in enumerate(found, 1):
        near = min(left[sample], default=None, key=lambda t: flat_distance(t["translation"], box["translation"]))
        if near and flat_distance(near["translation"], box["translation"]) < most:
            left[sample].remove(near)
            pairs.append((near, box))
        recall.append(len(pairs) / objects if objects else 0)
        precision.append(len(pairs) / n)
        scores.append(box["detection_score"])
    if not pairs:
        return objects, 0.0, dict.fromkeys(ERRORS, 1.0)
    # Rounded like nuScenes: 21 of 30 objects do not reach 0.7, because 0.01 * 70 is above 0.7.
    reached = [0.01 * k for k in range(11, 101) if 0.01 * k <= recall[-1]]
    ap = sum(max(0, read_off(r, recall, precision) - 0.1) for r in reached) / 90 / 0.9
    errors = {}
    for kind in ERRORS:
        values, means = [error(kind, t, b, name) for t, b in pairs], []
        for n in range(1, len(values) + 1):
            known = [v for v in values[:n] if v is not None]
            means.append(sum(known) / len(known) if known else 0.0)
        if not reached or all(v is None for v in values):
            errors[kind] = 1.0
            continue
        rising = [b["detection_score"] for _, b in pairs][::-1]
        curve = [read_off(read_off(r, recall, scores), rising, means[::-1]) for r in reached]
        errors[kind] = sum(curve) / len(curve)
    return objects, ap, errors


def evaluate(tables, results, classes):
    """Return {class: objects, ap by distance, errors}, mAP, mean errors and NDS over the ten classes."""
    samples, by_class = labels_by_sample(tables, classes), {}
    for name in RANGE:
        rows = {d: of_class(samples, results, name, d) for d in (0.5, 1.0, 2.0, 4.0)}
        by_class[name] = (
            rows[2.0][0],
            {d: row[1] for d, row in rows.items()},
            {k: v for k, v in rows[2.0][2].items() if k not in WITHOUT.get(name, ())},
        )
    return by_class, over(by_class, by_class)


def over(by_class, names):
    rows = [by_class[name] for name in names]
    mean_ap = sum(sum(ap.values()) / 4 for _, ap, _ in rows) / len(rows)
    errors = {}
    for kind in ERRORS:
        values = [e[kind] for _, _, e in rows if kind in e]
        errors[kind] = sum(values) / len(values)
    nds = (5 * mean_ap + sum(max(0.0, 1 - e) for e in errors.values())) / 10
    return mean_ap, errors, nds
