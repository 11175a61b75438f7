"""Small simulated data sets made by the command."""

from click.testing import CliRunner

from lidar_perception.cli.simulate import simulate
from lidar_perception.simulation.sensor import make_generic_sensor

TINY = make_generic_sensor(16, -14.0, 3.0, 2.0, 10.0)


def make_simulate_arguments(out, layout="kitti", frames=5, jobs=1, *more):
    return [
        "--out",
        str(out),
        "--format",
        layout,
        "--sensor",
        "tiny",
        "--frames",
        str(frames),
        "--seed",
        "3",
        "--jobs",
        str(jobs),
        *map(str, more),
    ]


def run_simulate(out, layout="kitti", frames=5, jobs=1, *more):
    result = CliRunner().invoke(simulate, make_simulate_arguments(out, layout, frames, jobs, *more))
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def read_files(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
