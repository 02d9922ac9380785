cdef double _extend(double[:, ::1] tours, double[:, ::1] times, double[::1] start, Py_ssize_t[::1] chosen, Py_ssize_t depth) noexcept nogil
cdef double _improve(double[:, ::1] times, double[::1] start, Py_ssize_t[::1] order, double seconds) except -1.0
cdef double _bound(const double[:, :, ::1] blocks, const double[:, ::1] prior, Py_ssize_t[::1] held, Py_ssize_t count, Py_ssize_t k, const double[:, ::1] relaxed, double[:, ::1] room, double[::1] gains) noexcept nogil
