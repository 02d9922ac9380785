cdef double _extend(double[:, ::1] tours, double[:, ::1] times, double[::1] start, Py_ssize_t[::1] chosen, Py_ssize_t depth) noexcept nogil
cdef double _improve(double[:, ::1] times, double[::1] start, Py_ssize_t[::1] order, double seconds) except -1.0
