cdef void _fill(double[:, ::1] tours, double[:, ::1] times, double[::1] start) noexcept nogil
cdef double _improve(double[:, ::1] times, double[::1] start, Py_ssize_t[::1] order, double seconds) except -1.0
