"""Cluster ids of candidates: each one names the cluster_id of the cloud."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from ros_samples import CLOUD, MARKERS, PAPER

from lidar_perception.candidates.pipeline import find_candidates, segment_cloud
from lidar_perception.candidates.seed_sources import make_fixed_source
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.data.open import open_recording
from lidar_perception.param_fields import with_values
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.wire.messages import read_column, to_point_cloud
from msg_utils.markers import from_marker_array

FILE = {"view.enabled": False, "seed.source": "file"}


def test_boxes_and_candidates_keep_the_ids_of_the_cloud(processes, peer, drive_bag):
    """The given ids have gaps, and most exceed a marker's 32 bits. candidate_refinement puts them into the text
    of its candidates. clustering replaces them in the cloud and the boxes."""
    params = with_values(PAPER, FILE)
    seed = make_fixed_source(load_seed(params.seed.file))
    scan = next(iter(open_recording(drive_bag))).load()
    segmented = segment_cloud(scan, None, params)
    assert len(segmented.indices) == len(scan)
    own = segmented.cluster_ids.astype(np.int64)
    foreign = np.where(own > 0, 2**32 - 5 - 7 * own, 0)
    msg = make_cloud_message(scan.xyz, ground=segmented.ground.astype("u1"), cluster_id=foreign.astype("u4"))
    _, expected = find_candidates(scan, seed, None, params, ground=segmented.ground, cluster_ids=foreign)
    assert len(expected.final) and expected.clusters.max() > 2**31 and set(expected.clusters) <= set(foreign)

    for node in ("candidate_refinement", "clustering"):
        processes.start(
            node,
            {
                "~/input/points": "/in",
                "~/output/detections": "/found",
                "~/output/boxes": "/boxes",
                "~/output/points": "/out",
            },
            {"seed.source": "file"},
        )
    found, boxes, out = (peer.listen("/found", MARKERS), peer.listen("/boxes", MARKERS), peer.listen("/out", CLOUD))
    peer.send(peer.advertise("/in", CLOUD), msg, lambda: found and boxes and out, "results of both")

    candidates = from_marker_array(found[-1])
    assert [text["cluster_id"] for text in candidates.extras] == expected.clusters.tolist()
    assert candidates.ids.tolist() == [*range(len(candidates))]
    np.testing.assert_array_equal(np.float32(candidates.boxes), expected.final.boxes)

    marked_cloud, marker_boxes = out[-1], from_marker_array(boxes[-1])
    xyz = to_point_cloud(marked_cloud)[0].xyz
    ids = read_column(marked_cloud, "cluster_id", np.arange(len(xyz)))
    assert set(ids) - {0} == set(marker_boxes.ids) == {text["id"] for text in marker_boxes.extras}
    for number, box in zip(marker_boxes.ids, marker_boxes.boxes, strict=True):
        inside = np.abs(xyz[ids == number][:, :2] - box[:2]) <= box[3:5] / 2 + 1e-3
        assert inside.all(), number
