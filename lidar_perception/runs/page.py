"""Reports as self-contained HTML pages."""

from __future__ import annotations

import base64
from typing import Any


def render_page(template: str, **values: Any) -> str:
    """Render a template of the package, such as "sensor_setup/report/report.html".

    Templates extend runs/page.html. Values are escaped; a name without a value is an error.
    """
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("lidar_perception", ""), autoescape=True,
        undefined=jinja2.StrictUndefined).get_template(template).render(values)


def to_data_url(picture: bytes, kind: str = "png") -> str:
    """Encode a picture as a data URL for <img>; kind is png or svg+xml."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"
