"""Extended Kalman filters of N objects on the ground, all at once.

State [x y vx vy heading turn], metres, seconds, radians, in a fixed frame: a velocity that turns at
a constant rate (Li and Jilkov, IEEE TAES 2003, Section V.B: coordinated turn with Cartesian
velocity). With a turn rate of 0 without variance it is the filter of constant velocity. means are
(N, 6), covariances (N, 6, 6), both float64; N may be 0.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.geometry import wrap_angle, wrap_line

X, Y, VX, VY, HEADING, TURN = range(6)
MEASURED = np.array([X, Y, HEADING])
OPPOSITE = 1.0   # scores by which measured headings must speak against a heading to turn it
STRAIGHT = 1e-4  # rad in one step; below this a series takes the place of sin(a) / a


def predict(means: np.ndarray, covariances: np.ndarray, seconds: float, acceleration: np.ndarray,
            turning: np.ndarray, wandering: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances so many seconds (0 or more) later; acceleration, turning and wandering
    (N,) are the densities of MotionParams."""
    t, count = seconds, len(means)
    _, _, vx, vy, _, turn = means.T
    angle = turn * t
    straight = np.abs(angle) < STRAIGHT
    safe = np.where(straight, 1.0, turn)
    sin, cos = np.sin(angle), np.cos(angle)
    along = np.where(straight, t, sin / safe)
    across = np.where(straight, angle * t / 2, (1.0 - cos) / safe)
    later = means.copy()
    later[:, X] += along * vx - across * vy
    later[:, Y] += across * vx + along * vy
    later[:, VX], later[:, VY] = cos * vx - sin * vy, sin * vx + cos * vy
    later[:, HEADING] = wrap_angle(means[:, HEADING] + angle)

    along_by_turn = np.where(straight, -angle * t * t / 3, (t * cos - along) / safe)
    across_by_turn = np.where(straight, t * t / 2, (t * sin - across) / safe)
    f = np.tile(np.eye(6), (count, 1, 1))
    f[:, X, VX] = f[:, Y, VY] = along
    f[:, X, VY], f[:, Y, VX] = -across, across
    f[:, VX, VX] = f[:, VY, VY] = cos
    f[:, VX, VY], f[:, VY, VX] = -sin, sin
    f[:, X, TURN] = along_by_turn * vx - across_by_turn * vy
    f[:, Y, TURN] = across_by_turn * vx + along_by_turn * vy
    f[:, VX, TURN], f[:, VY, TURN] = -t * later[:, VY], t * later[:, VX]
    f[:, HEADING, TURN] = t
    grown = f @ covariances @ f.transpose(0, 2, 1)
    for place, speed, density in ((X, VX, acceleration), (Y, VY, acceleration),
                                  (HEADING, TURN, turning)):
        square = density * density
        grown[:, place, place] += square * t ** 3 / 3
        grown[:, place, speed] += square * t * t / 2
        grown[:, speed, place] += square * t * t / 2
        grown[:, speed, speed] += square * t
    grown[:, HEADING, HEADING] += wandering * wandering * t
    return later, grown


def update(means: np.ndarray, covariances: np.ndarray, measured: np.ndarray,
           noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """With measured (N, 3) [x y heading], whose standard deviations are noise (N, 3). Of heading
    and its opposite the one nearer to the state's is taken: detectors confuse front and rear, of
    which facing_forward() decides."""
    innovation = measured - means[:, MEASURED]
    innovation[:, 2] = wrap_line(innovation[:, 2])
    against = covariances[:, :, MEASURED]
    spread = against[:, MEASURED]
    spread[:, range(3), range(3)] += noise * noise
    gain = np.linalg.solve(spread, against.transpose(0, 2, 1)).transpose(0, 2, 1)
    return _after(means + (gain @ innovation[:, :, None])[:, :, 0],
                  covariances - gain @ against.transpose(0, 2, 1))


def keep_to_heading(means: np.ndarray, covariances: np.ndarray,
                    slip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """With the knowledge that the speed across the heading is 0, with standard deviations slip
    (N,): wheels and feet go forward. It ties the heading to the motion, and the other way round."""
    sin, cos = np.sin(means[:, HEADING]), np.cos(means[:, HEADING])
    vx, vy = means[:, VX], means[:, VY]
    slope = np.zeros((len(means), 6))
    slope[:, VX], slope[:, VY], slope[:, HEADING] = -sin, cos, -(cos * vx + sin * vy)
    against = (covariances @ slope[:, :, None])[:, :, 0]
    spread = (slope * against).sum(axis=1) + slip * slip
    gain = against / spread[:, None]
    across = cos * vy - sin * vx
    return _after(means - gain * across[:, None],
                  covariances - gain[:, :, None] * against[:, None, :])


def facing_forward(means: np.ndarray, said: np.ndarray,
                   backwards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The means, and what measured headings said for theirs, said (N,), turned round where an
    object goes backwards faster than backwards (N,) m/s, and, unless it goes forward faster than
    that, where they said the opposite."""
    forward = (np.cos(means[:, HEADING]) * means[:, VX]
               + np.sin(means[:, HEADING]) * means[:, VY])
    wrong = (forward < -backwards) | (said < -OPPOSITE) & (forward <= backwards)
    turned = means.copy()
    turned[:, HEADING] = wrap_angle(means[:, HEADING] + np.pi * wrong)
    return turned, np.where(wrong, -said, said)


def _after(means: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heading wrapped, covariances symmetric."""
    means[:, HEADING] = wrap_angle(means[:, HEADING])
    return means, (covariances + covariances.transpose(0, 2, 1)) / 2


def turned(covariances: np.ndarray, cos: float, sin: float, side: float = 1.0) -> np.ndarray:
    """The covariances in axes in which the old x lies at [cos sin], and the old y to its left, or
    with side -1 to its right, as seen from below."""
    r = np.diag([cos, side * cos, cos, side * cos, side, side])
    for a, b in ((X, Y), (VX, VY)):
        r[a, b], r[b, a] = -side * sin, sin
    return r @ covariances @ r.T
