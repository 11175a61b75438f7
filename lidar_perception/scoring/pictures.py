"""Writing of Matplotlib figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lidar_perception.types import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save_picture(path: str | Path, figure: Figure, **options) -> None:
    """Write a figure as PNG and close it.

    Raises:
        InputError: The file cannot be written.
    """
    import matplotlib.pyplot as plt

    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format="png", **options)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    finally:
        plt.close(figure)
