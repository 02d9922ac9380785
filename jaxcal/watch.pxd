"""What every compiled loop asks: is the time over, was Ctrl-C pressed?

    watch: Watch = begin(seconds)
    while ...:
        if late(cython.address(watch)):  # raises KeyboardInterrupt
            break

Ask every microsecond to millisecond: it costs 25 ns.
"""

from cpython.exc cimport PyErr_CheckSignals
from posix.time cimport CLOCK_MONOTONIC, clock_gettime, timespec

cdef struct Watch:
    double end  # reading of the clock when the time is over
    double look  # reading when signals are looked at next

cdef inline double _now() noexcept nogil:
    cdef timespec time
    clock_gettime(CLOCK_MONOTONIC, &time)
    return time.tv_sec + 1e-9 * time.tv_nsec

cdef inline Watch begin(double seconds) noexcept nogil:
    """A watch whose time is over after ``seconds``; may be infinite."""
    cdef Watch watch
    cdef double now = _now()
    watch.end = now + seconds
    watch.look = now
    return watch

cdef inline int late(Watch* watch) except -1 nogil:
    """1 once the time is over, else 0; runs Python's signal handlers 20 times a second."""
    cdef double now = _now()
    if now >= watch.look:
        watch.look = now + 0.05
        with gil:
            PyErr_CheckSignals()
    return now >= watch.end
