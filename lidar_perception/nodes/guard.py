"""A compiled thread that ends the process after a signal, even when DDS is stuck."""

from __future__ import annotations

import threading

import numpy as np
from numba import njit, types

REACTION = 5.0  # seconds for the current work; a stuck one is not waited for
# Seconds for DDS to be taken down, after all is written. Cut short, it may leave a port in shared
# memory that others wait for. launch sends SIGTERM after 5 s.
TEARDOWN = 3.0
RUNNING, CLOSING, CLOSED = range(3)
TICK = 0.02  # seconds

SIGINFO = 128  # bytes of one signal, struct signalfd_siginfo

_read = types.ExternalFunction("read", types.intp(types.int32, types.uintp, types.uintp))
_write = types.ExternalFunction("write", types.intp(types.int32, types.uintp, types.uintp))
_usleep = types.ExternalFunction("usleep", types.int32(types.uint32))
_exit = types.ExternalFunction("_exit", types.void(types.int32))


def start_guard(signals: int, pipe: int) -> np.ndarray:
    """Start the thread that reads the first signal from the descriptor `signals`, see signalfd(2).

    It writes a byte to the pipe then. From there the process has REACTION seconds until its state
    is CLOSING, any time until it is CLOSED, and TEARDOWN seconds from there to its end.

    Returns:
        (2,) int64 state that the caller sets: the phase, and the exit code once it is CLOSED.
    """
    state = np.array([RUNNING, 0], np.int64)
    threading.Thread(target=_guard, args=(state, signals, pipe), daemon=True).start()
    return state


@njit("void(i8[::1], i8, i8)", nogil=True, cache=True)
def _guard(state, signals, pipe):
    signal = np.zeros(SIGINFO, np.uint8)
    while _read(signals, signal.ctypes.data, SIGINFO) < 0:
        _usleep(int(TICK * 1e6))
    _write(pipe, signal.ctypes.data, 1)
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
