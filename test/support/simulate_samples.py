"""Small simulated data sets made by the command."""

from click.testing import CliRunner

from lidar_perception.cli.simulate import simulate
from lidar_perception.simulation.sensor import make_generic_sensor

TINY = make_generic_sensor(16, -14.0, 3.0, 2.0, 10.0)


def arguments(out, layout="kitti", frames=5, jobs=1, *more):
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


def run(out, layout="kitti", frames=5, jobs=1, *more):
    result = CliRunner().invoke(simulate, arguments(out, layout, frames, jobs, *more))
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def content(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
