from jaxcal.watch cimport Watch

cdef double _length(double[:, ::1] points, Py_ssize_t c, Py_ssize_t dimension) noexcept nogil
cdef bint _too_short(double[:, ::1] points, Py_ssize_t first, Py_ssize_t size, Py_ssize_t dimension, double needed) noexcept nogil
cdef void _open(double[:, :, ::1] points, Py_ssize_t[:, ::1] index, Py_ssize_t[::1] size, double[::1] volume, Py_ssize_t depth, Py_ssize_t c, double reached, double[:, ::1] room, Py_ssize_t[:, ::1] order) noexcept nogil
cdef void _longest_first(double[:, ::1] room, Py_ssize_t[:, ::1] order, Py_ssize_t count) noexcept nogil
cdef int _best_pair(double[:, ::1] plane, Py_ssize_t[:, ::1] index, Py_ssize_t[::1] size, double[::1] volume, Py_ssize_t[::1] chosen, Py_ssize_t[::1] subset, double[::1] largest, Watch* watch) except -1 nogil
cdef double _polygon_bound(double[:, ::1] plane, Py_ssize_t count) noexcept nogil
