cimport cython

cdef struct State:
    int place
    double seconds
    int uses
    int made

@cython.final
cdef class Tree:
    cdef float[:, ::1] rows  # (S, wide)
    cdef float[:, :, ::1] likelihood  # (A, Y, S)
    cdef float[:, ::1] travel  # (P, D)
    cdef float[:, ::1] extra  # (Y, D)
    cdef float[:, ::1] uses  # (Y, D)
    cdef int[:, ::1] place_after  # (A, Y)
    cdef float[::1] most_extra  # (D,) seconds that must be left, besides the way
    cdef float[::1] most_uses  # (D,) uses that must be left
    cdef float[:, ::1] hints  # (N, D) multiples of scores
    cdef int horizon
    cdef double time, a, haste, doubt, effort
    cdef double[::1] use_of  # constant of a use, where 1 to _USES are left
    cdef float cut  # least weight that is followed, of that of its node
    cdef int designs  # D
    cdef int outcomes
    cdef int wide  # Y D
    cdef int[:, ::1] widths
    cdef int* width
    cdef double work
    # Of each level, the likely states and their number, sums and what follows from them:
    cdef int[::1] likely
    cdef int[:, ::1] which
    cdef float[:, ::1] weights
    cdef float[:, ::1] sums
    cdef float[:, ::1] rest
    cdef float[:, ::1] gains
    cdef float[:, ::1] scores
    cdef float[:, ::1] seconds
    cdef float[:, ::1] needs
    cdef float[:, ::1] open  # 1 where paid for, else 0
    cdef double[::1] guess
    cdef float[::1] belief  # of the session that is played
    cdef int _best(self, float* belief, State now) noexcept nogil
    cdef double _size(self, int number) noexcept nogil
    cdef void _sum(self, int level) noexcept nogil
    cdef double _value(self, int level, float p, State now, double entropy, int* best) noexcept nogil
    cdef double _propose(self, int level, float p, State now, int* best) noexcept nogil
    cdef void _open(self, int level, State now) noexcept nogil
    cdef double _follow(self, int level, float p, int a, State now, double entropy) noexcept nogil

cdef float _log(float x) noexcept nogil
cdef float _largest(float* values, int count, float sign) noexcept nogil
cdef int _argmax(float* values, int count) noexcept nogil
