"""Names of the files that a report writes into the folder of a run."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

REPORT = "report.json"  # written first, because it lists the tables and figures
PAGES = ("report.html", "report.md", REPORT)
FOLDERS = {"tables": ".csv", "figures": ".png"}


def list_report_files(folder: Path) -> list[Path]:
    """List the files of the report in a folder.

    Only tables and figures named in report.json are listed; other files do not belong to the report.
    """
    names = []
    with suppress(OSError, ValueError, KeyError, TypeError):  # the report is missing or has another format
        report = json.loads((folder / REPORT).read_text())
        names = [
            f"{folder_name}/{Path(item['name']).name}{suffix}"
            for section in report["sections"]
            for folder_name, suffix in FOLDERS.items()
            for item in section[folder_name]
        ]
    return [folder / name for name in (*names, *PAGES)]
