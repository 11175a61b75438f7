"""report.html: what was measured, with pictures, in one file."""

from __future__ import annotations

import base64
from importlib.resources import files

from lidar_perception.sensor_setup.figures import drawn
from lidar_perception.sensor_setup.findings import doubts, findings
from lidar_perception.sensor_setup.measure import Measured


def report_html(m: Measured, texts: dict[str, str]) -> str:
    """One page that needs no other file; texts: files that are shown in it, name to content."""
    import jinja2

    source = (files("lidar_perception.sensor_setup") / "report.html").read_text()
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    pictures = {title: "data:image/png;base64," + base64.b64encode(png).decode()
                for title, png in drawn(m).items()}
    return environment.from_string(source).render(
        title="A sensor, measured", scans=len(m.scans), total=m.total, source=m.source,
        findings=findings(m), doubts=doubts(m), pictures=pictures, texts=texts)
