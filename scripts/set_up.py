"""Install this checkout and its pinned packages into the environment of the running Python.

    python scripts/set_up.py EXTRA...

./lidar calls it. It installs with uv, which is much faster than pip and gets pip's settings as
options. uv is found on PATH or installed by pip. If uv fails or lacks one of the settings, pip
installs everything.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
PIP = [sys.executable, "-m", "pip"]
# Options of uv for settings of pip with one or more values, separated by whitespace.
OPTIONS = {
    "find-links": "--find-links",
    "index-url": "--default-index",
    "extra-index-url": "--index",
    "constraint": "--constraint",
    "trusted-host": "--allow-insecure-host",
    "only-binary": "--only-binary",
    "no-binary": "--no-binary",
}
VARIABLES = {
    "cert": "SSL_CERT_FILE",
    "timeout": "UV_HTTP_TIMEOUT",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "proxy": "ALL_PROXY",
}
IRRELEVANT = {
    "disable-pip-version-check",
    "no-color",
    "no-input",
    "no-python-version-warning",
    "progress-bar",
    "quiet",
    "retries",
    "root-user-action",
    "verbose",
    "cache-dir",
    "no-cache-dir",
    "break-system-packages",
    "require-virtualenv",
    "log",
    "no-warn-script-location",
    "config-file",
}


def main(extras: list[str]) -> int:
    """Install with uv, or else with pip; return the exit code."""
    target = f"{ROOT}[{','.join(extras)}]"
    if uv_options := find_uv_options(read_pip_settings()):
        options, variables = uv_options
        if (uv := find_uv()) and _run(
            [
                uv,
                "pip",
                "install",
                "--python",
                sys.executable,
                *options,
                "--constraint",
                str(CONSTRAINTS),
                "--editable",
                target,
                *find_torch(),
            ],
            variables,
        ):
            return 0
        print("set_up.py: pip installs instead of uv", flush=True)
    return (
        0
        if _run(
            [*PIP, "install", "--disable-pip-version-check", "--constraint", str(CONSTRAINTS), "--editable", target]
        )
        else 1
    )


def read_pip_settings() -> dict[str, str]:
    """Return the settings of `pip install` by name, from its files and environment variables."""
    output = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True).stdout
    by_section: dict[str, dict[str, str]] = {"global": {}, "install": {}, ":env:": {}}
    for line in output.splitlines():
        key, _, value = line.partition("=")
        section, _, name = key.rpartition(".")
        if section in by_section:
            by_section[section][name] = str(ast.literal_eval(value))
    return {name: value for settings in by_section.values() for name, value in settings.items()}


def find_uv_options(settings: dict[str, str]) -> tuple[list[str], dict[str, str]] | None:
    """Return options and environment variables of uv for settings of pip; None if uv lacks one."""
    options = ["--index-strategy", "unsafe-best-match"]  # as pip, which compares all indexes
    variables = {}
    for name, value in settings.items():
        if name in OPTIONS:
            options += [word for item in value.split() for word in (OPTIONS[name], item)]
        elif name in VARIABLES:
            variables[VARIABLES[name]] = value
        elif name == "no-index":
            options += ["--no-index"] * (value.lower() in ("1", "true", "yes", "on"))
        elif name not in IRRELEVANT:
            print(f"set_up.py: uv has no setting like pip's {name}", flush=True)
            return None
    return options, variables


def find_uv() -> str | None:
    """Return the path of uv, installed by pip if there is none; None if that fails."""
    installed = Path(sys.executable).with_name("uv")
    path = shutil.which("uv") or (str(installed) if installed.exists() else None)
    if path is None and _run([*PIP, "install", "--quiet", "--disable-pip-version-check", "uv"]):
        path = str(installed)
    return path


def find_torch() -> list[str]:
    """Return the requirement for the file of torch that pip would install, such as a CPU build.

    uv may choose another build of the same version if there are several indexes. [] if torch is
    installed; if pip finds no file, it installs torch.
    """
    try:
        version("torch")
        return []
    except PackageNotFoundError:
        pass
    report = subprocess.run(
        [
            *PIP,
            "install",
            "--dry-run",
            "--no-deps",
            "--quiet",
            "--report",
            "-",
            "--disable-pip-version-check",
            "--constraint",
            str(CONSTRAINTS),
            "torch",
        ],
        capture_output=True,
        text=True,
    )
    try:
        url = json.loads(report.stdout)["install"][0]["download_info"]["url"]
    except (ValueError, LookupError):
        print(report.stderr, f"set_up.py: pip installs torch, exit code {report.returncode}", flush=True)
        _run([*PIP, "install", "--disable-pip-version-check", "--constraint", str(CONSTRAINTS), "torch"])
        return []
    return [f"torch @ {url}"]


def _run(words: list[str], variables: dict[str, str] | None = None) -> bool:
    print("+", *words, flush=True)
    return subprocess.run(words, env={**os.environ, **(variables or {})}).returncode == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
