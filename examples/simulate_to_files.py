"""Simulate labelled clouds of your sensor as .npy files: python examples/simulate_to_files.py OUT.

OUT/NAME.npy has the points (N, 4) x y z intensity, OUT/labels/NAME.json the boxes of the objects.
"""

import json
import sys
from pathlib import Path

import numpy as np

import lidar_perception as lp

out = Path(sys.argv[1])
(out / "labels").mkdir(parents=True)
for frame in lp.simulate(3, seed=7, sensor="vlp-16", scene="campus", sensor_height=0.6):
    name = frame.name.replace("/", "_")
    np.save(out / f"{name}.npy", frame.load().points())
    truth = frame.truth()
    labels = [{"class": label, "box": box.tolist()} for label, box in zip(truth.labels, truth.boxes)] if truth else []
    (out / "labels" / f"{name}.json").write_text(json.dumps(labels))
recording = lp.open_recording(out)
print(recording)
print(f"{len(recording.frames[0].load())} points in the first cloud")
