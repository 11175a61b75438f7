"""How a node's process ends at a signal, even where DDS hangs and holds the interpreter's lock."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Collection

import numpy as np
from numba import njit, types

REACTION = 5.0  # seconds for the work in hand; what hangs longer is not waited for
TEARDOWN = 3.0  # seconds for DDS to be taken down, after all is written; cut short, it may leave
# others a port in shared memory that they wait for (docs/reliability.md); launch sends SIGTERM at 5
RUNNING, CLOSING, CLOSED = range(3)
TICK = 0.02  # seconds

_sigwait = types.ExternalFunction("sigwait", types.int32(types.uintp, types.uintp))
_write = types.ExternalFunction("write", types.intp(types.int32, types.uintp, types.uintp))
_usleep = types.ExternalFunction("usleep", types.int32(types.uint32))
_exit = types.ExternalFunction("_exit", types.void(types.int32))


class Stop:
    """Takes the given signals, which every thread must block, in threads of its own: as exceptions
    in the main thread they could be lost in a destructor, or cut short what must be finished.

    react is called at the first signal; until there is a node, it ends the process. Fast DDS can
    wait for a lock in shared memory that a process which died still holds, and rclpy holds the
    interpreter's lock meanwhile, so no Python thread runs: the guard is compiled code that needs
    neither. The node calls closing() before it writes its last, closed() after that.
    """

    def __init__(self, signals: Collection[signal.Signals]) -> None:
        self.react: Callable[[], object] = lambda: os._exit(0)
        self._state = np.array([RUNNING, 0], np.int64)  # phase, exit code
        waited_for = np.zeros(128, np.uint8)  # sigset_t
        for number in signals:
            waited_for[(number - 1) // 8] |= 1 << (number - 1) % 8
        self._awake, write = os.pipe()
        guarded = self._state, waited_for, write
        threading.Thread(target=_guard, args=guarded, daemon=True).start()
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        os.read(self._awake, 1)
        self.react()

    def closing(self) -> None:
        """The work is done; what follows may take its time."""
        self._state[0] = CLOSING

    def closed(self, code: int) -> None:
        """All is written: the process ends with this code within TEARDOWN seconds."""
        self._state[:] = CLOSED, code
        self.react = lambda: None
        os.kill(os.getpid(), signal.SIGTERM)  # wakes the guard, if no signal has


@njit("void(i8[::1], u1[::1], i8)", nogil=True, cache=True)
def _guard(state, signals, pipe):
    number = np.zeros(1, np.int32)
    _sigwait(signals.ctypes.data, number.ctypes.data)
    _write(pipe, number.ctypes.data, 1)
    waited = 0.0
    while state[0] == RUNNING:
        if waited > REACTION:
            _exit(0)
        _usleep(int(TICK * 1e6))
        waited += TICK
    while state[0] == CLOSING:
        _usleep(int(TICK * 1e6))
    _usleep(int(TEARDOWN * 1e6))
    _exit(state[1])
