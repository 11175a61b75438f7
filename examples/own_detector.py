"""Your own detector, without a network: detects every cluster that has the size of a person.

python examples/own_detector.py                                                # evaluates it
cd examples && lidar-perception detect drive.bag --weights own_detector:PersonSizedClusters
"""

import numpy as np

import lidar_perception as lp


class PersonSizedClusters:
    """Detector. Call an instance with a cloud to get Detections."""

    classes = ("Pedestrian",)

    def __init__(self, sensor_height: float = 1.73) -> None:
        self.sensor_height = sensor_height

    def __call__(self, cloud: lp.PointCloud) -> lp.Detections:
        ground = lp.segment_ground(cloud, sensor_height=self.sensor_height)
        cluster_ids = lp.cluster(cloud, ground=ground, min_samples=5)
        boxes = []
        for number in range(1, cluster_ids.max(initial=0) + 1):
            points = cloud.xyz[cluster_ids == number]
            size, centre = np.ptp(points, axis=0), (points.min(axis=0) + points.max(axis=0)) / 2
            if 1.2 < size[2] < 2.0 and size[:2].max() < 1.0:
                boxes.append([*centre, *size, 0.0])
        return lp.Detections.of(boxes, "Pedestrian", 0.5)


if __name__ == "__main__":
    result = lp.evaluate(PersonSizedClusters(), lp.simulate(5, seed=3, kind="zone"))
    precision = result["ap"]["Pedestrian"]["bev_relaxed"]["moderate"]
    print(f"Pedestrian, AP on {result['frames']} frames: {precision}")
