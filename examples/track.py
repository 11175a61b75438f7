"""Track objects over a recording or a simulated drive: python examples/track.py [drive.bag]."""

import sys

import numpy as np

import lidar_perception as lp

recording = lp.open_recording(sys.argv[1]) if sys.argv[1:] else lp.simulate(8)
height = recording.frames[0].sensor_height
detector = lp.load_detector(min_score=0.05, sensor_height=height)  # the tracker has its own thresholds
tracker = lp.Tracker()
for frame in recording:
    detections = detector(frame.load()).detections
    tracks = tracker(detections, frame.stamp_ns, frame.pose())
    print(f"{frame.name}: {len(tracks.ids)} tracks")
    for track_id, label, velocity in zip(tracks.ids, tracks.detections.labels, tracks.velocities):
        print(f"  {track_id:3} {label:10} {np.hypot(*velocity):4.1f} m/s")
