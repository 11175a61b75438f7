"""report.html: what was measured, with pictures, in one file."""

from __future__ import annotations

from lidar_perception.runs.page import render_page, to_data_url
from lidar_perception.sensor_setup.doubts import doubts
from lidar_perception.sensor_setup.figures import drawn
from lidar_perception.sensor_setup.findings import findings
from lidar_perception.sensor_setup.measure import Measured


def report_html(m: Measured, texts: dict[str, str]) -> str:
    """One page that needs no other file; texts: files that are shown in it, name to content."""
    return render_page(
        "sensor_setup/report.html", title="A sensor, measured", scans=len(m.scans), total=m.total,
        source=m.source, findings=findings(m), doubts=doubts(m), texts=texts,
        pictures={title: to_data_url(png) for title, png in drawn(m).items()})
