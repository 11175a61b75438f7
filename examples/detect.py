"""Detect objects in a recording, or in a simulated drive: python examples/detect.py [drive.bag]."""

import sys

import lidar_perception as lp

recording = lp.open_recording(sys.argv[1]) if sys.argv[1:] else lp.simulate(3)
detector = lp.load_detector(range="around", sensor_height=recording.frames[0].sensor_height)
for frame in recording:
    result = detector(frame.load())
    detections = result.detections
    print(f"{frame.name}: {len(detections)} objects")
    for label, score, box in zip(detections.labels, detections.scores, detections.boxes):
        x, y, _, length, width, height, yaw = box
        print(
            f"  {label:10} score {score:.2f}  x {x:6.1f} m  y {y:6.1f} m  "
            f"{length:.1f} x {width:.1f} x {height:.1f} m  yaw {yaw:5.2f} rad"
        )
    if result.problem:
        print(f"  {result.problem}")
