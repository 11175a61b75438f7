"""Laws of who is asked: a source that says no to what is there says nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from adapting_samples import FRAMES, KINDS, POST, boxes_at, drive

from lidar_perception.adapting.hearing import ALL, heard_of, recognised, unheard
from lidar_perception.adapting.judging import IGNORED, KEPT, REJECTED, judged
from lidar_perception.adapting.looking import FrameLook
from lidar_perception.adapting.tracks import tracks_of
from lidar_perception.data.frame import Frame
from lidar_perception.robot.poses import inverse, moved_boxes
from lidar_perception.types import GroundTruth, LidarFrame

TRUE = np.arange(len(KINDS)) != POST


def said(looks: list[FrameLook], **what: float) -> list[FrameLook]:
    """The looks where these sources say the same of everything."""
    return [replace(each, detections=replace(each.detections, sources={
        **each.detections.sources,
        **{name: np.full(len(each.detections), p, np.float32) for name, p in what.items()}}))
        for each in looks]


def counts_of(looks: list[FrameLook]) -> dict:
    """By simulated frames whose labels are what was there."""
    truths = [GroundTruth.of(moved_boxes(boxes_at(i / 10), inverse(look.pose))[TRUE], KINDS[TRUE])
              for i, look in enumerate(looks)]
    scan = LidarFrame(np.zeros((1, 3), np.float32), None)
    seen = iter(looks)
    return recognised(lambda frame, pose: next(seen),
                      [Frame.of(str(i), scan, truth) for i, truth in enumerate(truths)])


def states(looks: list[FrameLook], stamps: list[int], heard) -> list[str]:
    start = inverse(looks[0].pose)
    way = np.array([(start @ look.pose)[:2, 3] for look in looks])
    return sorted(judged(track, way, heard).state for track in tracks_of(looks, stamps))


def test_a_source_that_is_deaf_to_this_sensor_keeps_nothing_from_being_learned():
    looks, stamps, _ = drive()
    deaf = said(looks, network=0.1, silhouette=0.01)
    assert states(deaf, stamps, ALL) == [IGNORED] * 4 + [REJECTED]
    counts = counts_of(deaf)
    assert counts["Pedestrian"]["silhouette"] == (0, 2 * FRAMES)
    assert set(heard_of(counts).values()) == {("classifier",)}
    assert states(deaf, stamps, heard_of(counts)) == [KEPT] * 4 + [REJECTED]
    assert any("Pedestrian: the silhouette is not asked" in line for line in unheard(counts))


def test_one_that_recognises_most_of_what_is_there_is_asked():
    looks, _, _ = drive()
    counts = counts_of(looks)
    assert heard_of(counts) == {k: tuple(v) for k, v in ALL.items()} and not unheard(counts)


def test_where_no_source_recognises_anything_nothing_is_kept():
    looks, stamps, _ = drive()
    deaf = heard_of(counts_of(said(looks, network=0.1, silhouette=0.1, classifier=0.1)))
    assert KEPT not in states(looks, stamps, deaf)
