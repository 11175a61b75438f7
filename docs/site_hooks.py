"""Hooks of MkDocs: links to files of the repository, and the page of all commands."""

from __future__ import annotations

import os
import re
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import click
from click.testing import CliRunner

from lidar_perception.cli.main import cli

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s#]+)(#[^)]*)?\)")


@cache  # a page has many links
def repository() -> str:
    """Return the https address of the repository that setup.py would write, or ""."""
    url = os.environ.get("LIDAR_REPOSITORY_URL", "")
    if not url:
        asked = subprocess.run(
            ["git", "-C", str(ROOT), "config", "remote.origin.url"], capture_output=True, text=True, check=False
        )
        url = asked.stdout.strip()
    return url.removesuffix(".git") if url.startswith("https://") else ""


def commands(group: click.Group, words: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Return the words of every command below a group, in the order of its help."""
    found: list[tuple[str, ...]] = []
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        below = commands(command, (*words, name)) if isinstance(command, click.Group) else []
        found += below or [(*words, name)]
    return found


def help_of_all() -> str:
    """Return the help texts of all commands as Markdown."""
    return "".join(
        f"\n## {' '.join(words)}\n\n```text\n"
        + CliRunner().invoke(cli, [*words, "--help"], prog_name="lidar-perception").output
        + "```\n"
        for words in commands(cli)
    )


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace links to files of the repository: by its address, or by their plain text."""
    if page.file.src_uri == "reference/cli.md":
        return markdown + help_of_all()
    folder = (DOCS / page.file.src_uri).parent

    def replace(match: re.Match[str]) -> str:
        text, target, anchor = match[1], match[2], match[3] or ""
        if "://" in target or target.startswith("/"):
            return match[0]
        path = Path(os.path.normpath(folder / target))
        in_docs = path.is_relative_to(DOCS) and path.suffix != ".py"
        if in_docs or not path.is_relative_to(ROOT):
            return match[0]
        url = repository()
        return f"[{text}]({url}/blob/main/{path.relative_to(ROOT)}{anchor})" if url else text

    return LINK.sub(replace, markdown)
