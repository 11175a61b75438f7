"""The page report.html: measured values, warnings, pictures and files in one HTML file."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.runs.page import render_page, to_data_url
from lidar_perception.sensor_setup.measurement.measure import SensorMeasurement
from lidar_perception.sensor_setup.report.figures import draw_figures
from lidar_perception.sensor_setup.report.values import list_values
from lidar_perception.sensor_setup.report.warnings import find_warnings


def format_page(m: SensorMeasurement, texts: dict[str, str]) -> str:
    """Return a page that needs no other file. texts: names and contents of files to show in it."""
    return render_page(
        Path(__file__).with_name("report.html"), title="Sensor setup", scans=len(m.source.scans),
        total=m.source.total, source=m.source.name, values=list_values(m),
        warnings=find_warnings(m), texts=texts,
        pictures={title: to_data_url(png) for title, png in draw_figures(m).items()})
