"""Install this checkout and its pinned packages into the environment of the running Python.

    python scripts/set_up.py EXTRA...

./lidar calls this script. It installs with uv, which is much faster than pip, and passes pip's
settings to it as options. uv is found on PATH or installed with pip. If uv fails or does not support
one of the settings, everything is installed with pip.
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
# Setting of pip -> option of uv. The settings have one or more values, separated by whitespace.
OPTIONS = {
    "find-links": "--find-links",
    "index-url": "--default-index",
    "extra-index-url": "--index",
    "constraint": "--constraint",
    "trusted-host": "--allow-insecure-host",
    "only-binary": "--only-binary",
    "no-binary": "--no-binary",
}
VARIABLES = {  # setting of pip -> environment variable of uv
    "cert": "SSL_CERT_FILE",
    "timeout": "UV_HTTP_TIMEOUT",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "proxy": "ALL_PROXY",
}
IGNORED_SETTINGS = {
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
    """Install with uv, or with pip if that fails. Return the exit code."""
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
        print("set_up.py: installing with pip instead of uv", flush=True)
    return (
        0
        if _run(
            [*PIP, "install", "--disable-pip-version-check", "--constraint", str(CONSTRAINTS), "--editable", target]
        )
        else 1
    )


def read_pip_settings() -> dict[str, str]:
    """Return the settings of `pip install` by name, from its configuration files and environment variables."""
    output = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True).stdout
    sections: dict[str, dict[str, str]] = {"global": {}, "install": {}, ":env:": {}}
    for line in output.splitlines():
        key, _, value = line.partition("=")
        section, _, name = key.rpartition(".")
        if section in sections:
            sections[section][name] = str(ast.literal_eval(value))
    return {name: value for settings in sections.values() for name, value in settings.items()}


def find_uv_options(settings: dict[str, str]) -> tuple[list[str], dict[str, str]] | None:
    """Convert settings of pip to options and environment variables of uv. None if uv does not support one of them."""
    options = ["--index-strategy", "unsafe-best-match"]  # pip compares all indexes too
    variables = {}
    for name, value in settings.items():
        if name in OPTIONS:
            options += [word for item in value.split() for word in (OPTIONS[name], item)]
        elif name in VARIABLES:
            variables[VARIABLES[name]] = value
        elif name == "no-index":
            options += ["--no-index"] * (value.lower() in ("1", "true", "yes", "on"))
        elif name not in IGNORED_SETTINGS:
            print(f"set_up.py: uv does not support pip's setting {name}", flush=True)
            return None
    return options, variables


def find_uv() -> str | None:
    """Return the path of uv. It is installed with pip if it is missing; None if that fails."""
    local_path = Path(sys.executable).with_name("uv")
    path = shutil.which("uv") or (str(local_path) if local_path.exists() else None)
    if path is None and _run([*PIP, "install", "--quiet", "--disable-pip-version-check", "uv"]):
        path = str(local_path)
    return path


def find_torch() -> list[str]:
    """Return the requirement for the torch file that pip would install, such as a CPU build.

    uv might choose another build of the same version if there are several indexes. Returns [] if
    torch is already installed. If pip reports no file, torch is installed with pip.
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
        print(
            report.stderr,
            f"set_up.py: pip's report failed ({report.returncode}); installing torch with pip",
            flush=True,
        )
        _run([*PIP, "install", "--disable-pip-version-check", "--constraint", str(CONSTRAINTS), "torch"])
        return []
    return [f"torch @ {url}"]


def _run(words: list[str], variables: dict[str, str] | None = None) -> bool:
    print("+", *words, flush=True)
    return subprocess.run(words, env={**os.environ, **(variables or {})}).returncode == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
