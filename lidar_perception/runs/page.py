"""Reports as self-contained HTML pages."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any


def render_page(template: Path, **values: Any) -> str:
    """Render the template in a file, which may extend page.html of this folder.

    Values are escaped; a name without a value is an error.
    """
    import jinja2

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, Path(__file__).parent]), autoescape=True,
        undefined=jinja2.StrictUndefined).get_template(template.name).render(values)


def to_data_url(picture: bytes, kind: str = "png") -> str:
    """Encode a picture as a data URL for <img>; kind is png or svg+xml."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"
