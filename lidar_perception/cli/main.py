"""Main command lidar-perception; the modules of its commands are imported on first use."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import click

from lidar_perception import __version__
from lidar_perception.cli.command import Group

COMMANDS = {  # name -> (module.function, description in the overview)
    "demo": ("lidar_perception.cli.demo.demo", "Replay a drive through the ROS 2 nodes and score the result."),
    "convert": ("lidar_perception.cli.convert.convert", "Convert recordings and labels to bags and other formats."),
    "detect": ("lidar_perception.cli.detect.detect", "Run a detector on a recording and write its results."),
    "evaluate": ("lidar_perception.cli.evaluate.group.evaluate", "Score the algorithms without ROS."),
    "view": ("lidar_studio.cli.view.view", "Show a recording and its results in the browser."),
    "setup": ("lidar_perception.cli.setup.setup", "Measure a sensor and its mounting from unlabelled clouds."),
    "label": ("lidar_studio.cli.label.label", "Label a drive in the browser."),
    "seed": ("lidar_perception.cli.seed.seed", "Create a template of a seed pedestrian."),
    "simulate": ("lidar_perception.cli.simulate.simulate", "Write simulated, labelled scans as a bag or a data set."),
    "train": ("lidar_perception.cli.train.train", "Train a detector on recordings or simulated streets."),
    "import-weights": (
        "lidar_perception.cli.weights.import_weights",
        "Import PointPillars weights from other projects.",
    ),
    "export": ("lidar_perception.cli.weights.export", "Export a network for another runtime."),
    "info": ("lidar_perception.cli.info.info", "Print the contents of a bag or another recording."),
    "run": ("lidar_perception.cli.run.run_node", "Start one ROS node."),
}


class LazyGroup(Group):
    """A group that imports the module of a command on first use.

    Args:
        commands_by_name: {name: (module.function, description in the overview)}.
    """

    def __init__(self, *args: Any, commands_by_name: dict[str, tuple[str, str]], **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.commands_by_name = commands_by_name

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands_by_name)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in self.commands_by_name:
            return None
        module, _, function = self.commands_by_name[name][0].rpartition(".")
        return getattr(importlib.import_module(module), function)

    def invoke(self, ctx: click.Context) -> Any:
        """Exit with code 130 on ctrl-C, as other programs do; click would exit with 1."""
        from lidar_perception.runs.terminal import show_input_warnings

        try:
            with show_input_warnings():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            ctx.exit(130)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in self.commands_by_name.items()])


@click.group(cls=LazyGroup, commands_by_name=COMMANDS, context_settings=dict(help_option_names=["-h", "--help"]))
@click.version_option(__version__, prog_name="lidar-perception")
def cli() -> None:
    """LiDAR perception for ROS 2: ground, clusters, pedestrian candidates, learned detectors of
    cars, pedestrians and cyclists, a simulator and training.

    \b
    Examples:
      lidar-perception demo
      lidar-perception demo /data/kitti/tracking
      lidar-perception convert /data/kitti/object --out kitti.bag
      lidar-perception evaluate candidates /data/kitti/object --json scores.json
      lidar-perception detect drive.bag --out results
      lidar-perception run fused_detector --ros-args -r '~/input/points:=/points'

    Exit codes: 0 success, 1 partial failure (such as skipped frames), 2 invalid command or input,
    130 stopped by ctrl-C.
    """


def run_cli(group: click.Group, name: str) -> None:
    """Run a group of commands; print bad input as one line on stderr and exit with code 2."""
    from lidar_perception.runs.files import convert_os_errors
    from lidar_perception.runs.memory import keep_freed_memory
    from lidar_perception.runs.threads import use_passive_waiting
    from lidar_perception.types import InputError

    use_passive_waiting()
    keep_freed_memory()
    try:
        with convert_os_errors():
            group(prog_name=name)
    except InputError as error:
        click.echo(f"Error: {error}", err=True)
        sys.exit(2)


def main() -> None:
    run_cli(cli, "lidar-perception")


if __name__ == "__main__":
    main()
