"""Score detectors on labelled frames: python examples/evaluate.py [DATA [DETECTOR ...]].

DATA is a bag with labels or the folder of a data set, such as /data/kitti/object.
"""

import sys

import lidar_perception as lp

recording = lp.open_recording(sys.argv[1]) if sys.argv[1:] else lp.simulate(5, seed=3)
for name in sys.argv[2:] or ["pointpillars", "fused"]:
    result = lp.evaluate(name, recording)
    print(f"{name} on {result['frames']} frames, AP in %")
    for class_name, rows in result["ap"].items():
        precision = rows["bev_relaxed"]["moderate"]
        if precision is not None:
            print(f"  {class_name:10} {precision['r40']:5.1f} of {precision['objects']} objects")
