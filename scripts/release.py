"""Make a release: python scripts/release.py X.Y.Z

Sets the version in lidar_perception/__init__.py and package.xml, renames the changelog's section
"Unreleased" to the version, commits, and tags vX.Y.Z. Does not push.
"""

from __future__ import annotations

import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EMPTY = "## Unreleased\n\n### Added\n\n### Changed\n\n### Fixed\n\n### Removed\n\n"


def set_version(root: Path, version: str) -> None:
    """Write the version into the two files that contain it."""
    for name, pattern in (
        ("lidar_perception/__init__.py", r'(__version__ = ")[^"]+'),
        ("package.xml", r"(<version>)[^<]+"),
    ):
        path = root / name
        text, count = re.subn(pattern, rf"\g<1>{version}", path.read_text())
        if count != 1:
            raise SystemExit(f"{path} contains {count} versions, expected one")
        path.write_text(text)


def date_changelog(text: str, version: str, day: str) -> str:
    """Move the unreleased changes of a changelog to a section for the version."""
    match = re.search(r"(?ms)^## Unreleased\n(.*?)(?=^## |\Z)", text)
    if match is None:
        raise SystemExit("CHANGELOG.md has no section 'Unreleased'")
    parts = re.split(r"(?m)^(?=### )", match[1])
    changes = "".join(part.rstrip() + "\n\n" for part in parts if len(part.strip().splitlines()) > 1)
    if not changes:
        raise SystemExit("CHANGELOG.md has no unreleased changes")
    return f"{text[: match.start()]}{EMPTY}## {version} - {day}\n\n{changes}{text[match.end() :]}"


def main(version: str) -> None:
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise SystemExit(f"invalid version {version}; expected X.Y.Z")
    changelog = ROOT / "CHANGELOG.md"
    day = datetime.now(UTC).date().isoformat()
    text = date_changelog(changelog.read_text(), version, day)
    if subprocess.check_output(["git", "status", "--porcelain"], cwd=ROOT, text=True):
        raise SystemExit("the checkout has uncommitted changes; commit them first")
    set_version(ROOT, version)
    changelog.write_text(text)
    subprocess.run(["git", "commit", "-qam", f"Release {version}"], cwd=ROOT, check=True)
    subprocess.run(["git", "tag", "-a", f"v{version}", "-m", f"Version {version}"], cwd=ROOT, check=True)
    print(f"tagged v{version}; publish it with: git push --follow-tags")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(sys.argv[1])
