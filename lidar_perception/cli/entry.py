"""Entry point of lidar-perception; `run NODE` blocks signals early, as nodes do."""

from __future__ import annotations

import signal
import sys


def main() -> None:
    if sys.argv[1:2] == ["run"]:
        # Handled before click and other modules are imported. The node replaces this process and inherits its
        # signal mask and pending signals.
        from lidar_perception.nodes.main import STOP_SIGNALS

        signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    from lidar_perception.cli.main import main as command

    command()
