"""Tracking scores from their definitions, one box at a time. The code is slow and independent of the package. A
frame is (labels, tracks, alike, overlap): labels [(id, ignored)], tracks [(id, score, excused)], and two
functions of their indices. Assignments are found by brute force.
"""

from itertools import permutations

import numpy as np


def best_assignment(rows, columns, gain):
    """Return the pairs (row, column) with the largest sum of gains; all gains are above 0."""
    few, many, flipped = (rows, columns, False) if rows <= columns else (columns, rows, True)
    best, pairs = -1.0, []
    for chosen in permutations(range(many), few):
        candidate = [(j, i) if flipped else (i, j) for i, j in enumerate(chosen)]
        total = sum(gain(i, j) for i, j in candidate)
        if total > best + 1e-12:
            best, pairs = total, candidate
    return sorted((i, j) for i, j in pairs if gain(i, j) > 1e-15)


def drop_ignored_labels(frames):
    """Remove ignored labels: return frames of labels [id], tracks [id], alike {(i, j): s}."""
    result = []
    for labels, tracks, alike, _ in frames:
        pairs = best_assignment(
            len(labels), len(tracks), lambda i, j, alike=alike: alike(i, j) if alike(i, j) >= 0.5 else 0
        )
        gone = {j for i, j in pairs if labels[i][1]}
        free = set(range(len(tracks))) - {j for _, j in pairs}
        gone |= {j for j in free if tracks[j][2]}
        rows = [i for i, (_, ignored) in enumerate(labels) if not ignored]
        columns = [j for j in range(len(tracks)) if j not in gone]
        result.append(
            (
                [labels[i][0] for i in rows],
                [tracks[j][0] for j in columns],
                {(a, b): alike(i, j) for a, i in enumerate(rows) for b, j in enumerate(columns)},
            )
        )
    return result


def compute_hota(sequences):
    """Return HOTA, DetA and AssA."""
    alphas = [0.05 * k for k in range(1, 20)]
    tp, labels, boxes, associated = ([0.0] * len(alphas) for _ in range(4))
    for frames in map(drop_ignored_labels, sequences):
        length, found, together = {}, {}, {}
        for true, tracks, alike in frames:
            for i in true:
                length[i] = length.get(i, 0) + 1
            for j in tracks:
                found[j] = found.get(j, 0) + 1
            for (a, b), s in alike.items():
                row = sum(alike[a, k] for k in range(len(tracks)))
                column = sum(alike[k, b] for k in range(len(true)))
                if row + column - s > 0:
                    key = true[a], tracks[b]
                    together[key] = together.get(key, 0) + s / (row + column - s)
        for number, alpha in enumerate(alphas):
            matches = {}
            for true, tracks, alike in frames:

                def gain(a, b, true=true, tracks=tracks, alike=alike, together=together, length=length, found=found):
                    c = together.get((true[a], tracks[b]), 0)
                    return alike[a, b] * c / (length[true[a]] + found[tracks[b]] - c)

                for a, b in best_assignment(len(true), len(tracks), gain):
                    if alike[a, b] >= alpha - 1e-15:
                        key = true[a], tracks[b]
                        matches[key] = matches.get(key, 0) + 1
                labels[number] += len(true)
                boxes[number] += len(tracks)
            tp[number] += sum(matches.values())
            associated[number] += sum(n * n / (length[i] + found[j] - n) for (i, j), n in matches.items())
    det = [t / max(1, a + b - t) for t, a, b in zip(tp, labels, boxes)]
    ass = [s / max(1, t) for s, t in zip(associated, tp)]
    return (float(np.mean([(d * a) ** 0.5 for d, a in zip(det, ass)])), float(np.mean(det)), float(np.mean(ass)))


def compute_clear(sequences):
    """Return tp, fn, fp, switches and fragments."""
    tp = fn = fp = switches = fragments = 0
    for frames in map(drop_ignored_labels, sequences):
        last, before, ever = {}, {}, set()
        for true, tracks, alike in frames:
            if not true or not tracks:
                fn, fp = fn + len(true), fp + len(tracks)
                continue

            def gain(a, b, true=true, tracks=tracks, alike=alike, before=before):
                s = alike[a, b]
                return 0 if s < 0.5 else s + 1000 * (before.get(true[a]) == tracks[b])

            pairs = best_assignment(len(true), len(tracks), gain)
            now = {true[a]: tracks[b] for a, b in pairs}
            for i, j in now.items():
                switches += i in last and last[i] != j
                fragments += i not in before and i in ever
            last.update(now)
            ever |= set(now)
            before = now
            tp, fn, fp = (tp + len(now), fn + len(true) - len(now), fp + len(tracks) - len(now))
    return tp, fn, fp, switches, fragments


def compute_over_recall(sequences):
    """Return sAMOTA, AMOTA and AMOTP."""
    mean = []
    for frames in sequences:
        scores = {}
        for _, tracks, _, _ in frames:
            for j, score, _ in tracks:
                scores.setdefault(j, []).append(score)
        mean.append({j: sum(s) / len(s) for j, s in scores.items()})
    once = set()

    def count(threshold):
        tp = fn = fp = switches = need = 0
        total, hits = 0.0, []
        for number, (frames, score) in enumerate(zip(sequences, mean)):
            stories = {}
            for f, (labels, tracks, _, overlap) in enumerate(frames):
                kept = [j for j, (i, _, _) in enumerate(tracks) if score[i] >= threshold]
                pairs = best_assignment(
                    len(labels),
                    len(kept),
                    lambda a, b, overlap=overlap, kept=kept: (
                        overlap(a, kept[b]) + 10 if overlap(a, kept[b]) >= 0.25 else 0
                    ),
                )
                pairs = {a: kept[b] for a, b in pairs}
                once.update((number, f, j) for j in pairs.values())
                for a, (i, ignored) in enumerate(labels):
                    hit = a in pairs
                    need, tp = need + (not ignored), tp + hit
                    fn += not hit and not ignored
                    stories.setdefault(i, []).append((tracks[pairs[a]][0] if hit else -1, ignored))
                    if hit:
                        total += overlap(a, pairs[a])
                        hits.append(score[tracks[pairs[a]][0]])
                fp += sum(j not in pairs.values() and not (tracks[j][2] and (number, f, j) not in once) for j in kept)
            for story in stories.values():
                known = story[0][0]
                for k in range(1, len(story)):
                    track, ignored = story[k]
                    if ignored:
                        known = -1
                    elif track != -1:
                        switches += known not in (-1, track) and story[k - 1][0] != -1
                        known = track
        return tp, fn, fp, switches, need, total, sorted(hits, reverse=True)

    tp, fn, _, _, _, _, hits = count(-np.inf)
    objects, wanted, points = tp + fn, 0.0, []
    for k, score in enumerate(hits):
        last = k + 1 == len(hits)
        following = (k + 1) / objects if last else (k + 2) / objects
        if not last and following - wanted < wanted - (k + 1) / objects:
            continue
        points.append((score, wanted))
        wanted += 1 / 40
    smota = mota = motp = 0.0
    for score, recall in points[1:]:
        tp, fn, fp, switches, need, total, _ = count(score)
        wrong = fn + fp + switches
        mota += 1 - wrong / need
        smota += min(1, max(0, 1 - (wrong - (1 - recall) * need) / (recall * need)))
        motp += total / max(tp, 1)
    return smota / 40, mota / 40, motp / 40
