"""python -m experiments COMMAND: the commands of this folder, which are imported only when called."""

from __future__ import annotations

import click

from lidar_perception.cli.main import LazyGroup, run_cli

COMMANDS = {  # name -> (module.function, description in the overview)
    "compare": ("experiments.comparison.command.compare", "Run every detector on the same frames, side by side."),
    "realism": ("experiments.realism.command.realism", "Compare simulated scans with real ones."),
    "reproduce": ("experiments.framework.command.reproduce", "Reproduce the tables of a paper."),
}


@click.group(cls=LazyGroup, commands_by_name=COMMANDS, context_settings=dict(help_option_names=["-h", "--help"]))
def cli() -> None:
    """Experiments on lidar_perception, from a checkout.

    \b
    Examples:
      ./lidar compare /data/kitti/object --json compare.json
      ./lidar realism /data/kitti/object --json realism.json
      ./lidar reproduce stm-cpa /data/kitti/object --out report
    """


def main() -> None:
    run_cli(cli, "./lidar")


if __name__ == "__main__":
    main()
