cdef void _behind_best(double[:, ::1] values) noexcept nogil
cdef void _features(double[:, ::1] y, unsigned char[::1] active, double[:, ::1] values, float[:, ::1] features, float[:, ::1] moments) noexcept nogil
cdef void _conditional(double[:, ::1] x, Py_ssize_t[:] chosen, unsigned char[::1] active, Py_ssize_t k, double[:, ::1] y, double[::1] inner) noexcept nogil
cdef int _look_ahead(double[:, ::1] y, unsigned char[::1] active, bint spanned, Py_ssize_t depth, bint best_only, double[:, ::1] values, double[:, ::1] work, double[::1] weights) except -1 nogil
cdef void _combine(double[::1] weights, double[:, ::1] rows, Py_ssize_t count) noexcept nogil
cdef double _least_start(double[::1] square, double largest) noexcept nogil
