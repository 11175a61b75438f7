"""Reports as HTML pages that need no other file."""

from __future__ import annotations

import base64
from typing import Any


def render(template: str, **values: Any) -> str:
    """The page of a template inside the package, such as "sensor_setup/report.html", which extends
    runs/page.html. It escapes values, and a name without a value is an error."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("lidar_perception", ""), autoescape=True,
        undefined=jinja2.StrictUndefined).get_template(template).render(values)


def data_url(picture: bytes, kind: str = "png") -> str:
    """What <img> shows without a file; kind: png or svg+xml."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"
