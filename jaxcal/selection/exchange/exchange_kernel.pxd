cimport cython
from jaxcal.watch cimport Watch

cdef enum:
    WIDE = 64  # candidates in a group

cdef class Climber:
    cdef int k, fixed, groups  # to choose, of them required; groups of candidates
    cdef Py_ssize_t available  # candidates that may be chosen
    cdef const Py_ssize_t[::1] caps  # (M,) how often each may be
    cdef const double[:, ::1] rules  # (r, M), whose sums over the chosen are at most
    cdef const double[::1] most  # (r,)
    cdef const Py_ssize_t[:, ::1] order  # (r, M) candidates, the cheapest first
    cdef Py_ssize_t[::1] counts  # (M,)
    cdef Py_ssize_t[::1] tried  # (M,) swaps made when a candidate was last tried
    cdef Py_ssize_t[::1] chosen  # (k,), the required first
    cdef double* closed  # (groups WIDE,), inf where it may not be chosen once more
    cdef unsigned long long state  # of the random numbers
    cdef Watch watch
    cdef int sweep, looked  # groups in a look at all candidates; since the clock was read
    cdef void _clear(self) noexcept nogil
    cdef void _count(self, Py_ssize_t i, int more) noexcept nogil
    cdef bint _restrict(self, Py_ssize_t out, Py_ssize_t more) noexcept nogil
    cdef bint _allowed(self) noexcept nogil
    cdef Py_ssize_t _draw(self, Py_ssize_t below) noexcept nogil
    cdef void _random_start(self) noexcept nogil
    cdef int _late(self) except -1 nogil
    cdef int _grow(self, Py_ssize_t size, double share) except -1 nogil
    cdef void _fill(self, Py_ssize_t size) noexcept nogil
    cdef double _finish(self, bint climbs) except? -2.0 nogil
    cdef double _climb(self, bint least) except? -2.0 nogil
    cdef void _set_known(self, double share, double ridge) noexcept nogil
    cdef double _evaluate(self, Py_ssize_t size, bint trial) noexcept nogil
    cdef void _refresh(self) noexcept nogil
    cdef void _carry(self, Py_ssize_t came, Py_ssize_t went) noexcept nogil
    cdef Py_ssize_t _addition(self) noexcept nogil
    cdef Py_ssize_t _replacement(self, Py_ssize_t out, double value, double rise) noexcept nogil
    cdef double _least_of_chosen(self) noexcept nogil
    cdef Py_ssize_t _strongest(self, Py_ssize_t at, double* least) noexcept nogil
    cdef int kind  # of ``criterion_kinds.pxd``
    cdef int parts  # 1 where V is enough, 2 with X
    cdef int dets  # of which the determinant counts
    cdef bint rows  # one reading each, and DET
    cdef int q, p, s
    cdef Py_ssize_t size  # q q WIDE
    cdef double[::1] room  # which holds all that is a pointer below
    cdef const double[:, :, ::1] blocks  # (M, q, p)
    cdef double* columns  # (groups, q, p, WIDE), zeros after the M
    cdef const double[:, ::1] prior  # (p, p)
    cdef const double[:, ::1] root  # C (s, p)
    cdef Py_ssize_t[::1] times  # (M,) in a sum of many replicates
    cdef double* known  # (p, p) what counts beside the chosen
    cdef double* gram
    cdef double* lower
    cdef double* now  # (2, p, p) V and X of the chosen
    cdef double* trial  # (2, p, p) of those after a swap
    cdef double* half  # (s, p) C V
    cdef double* solved  # (s, p)
    cdef double* small  # (s, s)
    cdef double* other  # (s, s)
    cdef double* grown  # (groups, 2, q, q, WIDE) D_jj and H_jj
    cdef double* kept  # (groups, 2, q, q, WIDE) K
    cdef double* alone  # (groups, WIDE)
    cdef double* tops  # (groups, 2) largest gain alone and trace of D_jj
    cdef double tallest  # trace of D_jj since they were last made anew
    cdef double* gain  # (WIDE,)
    cdef double* det  # (WIDE,)
    cdef double* cross  # (2, 2 q, q, WIDE) D_ij and H_ij of a group
    cdef double* work  # (4, q, q, WIDE)
    cdef double* mixed  # (2 q, q, WIDE)
    cdef double* middle  # (3, 2 q, 2 q) P of both; of a trace P U A.T P the second
    cdef double* changed  # (2 q, p) blocks that came and went
    cdef double* at_out  # (2, q, q) D_ii and H_ii
    cdef double* tall  # (2, 2 q, p) B_i V and B_i X
    cdef double* halved  # (p, p) V or X, with half its diagonal
    cdef double* part  # (p, WIDE)
    cdef double* rest  # (p, p) information of the chosen but one
    cdef double* metric  # (p, p) R
    cdef double* bounds  # (groups, WIDE) on E
    cdef double* weakest  # (p,) y
    cdef double* values  # (p,) eigenvalues of C V C.T, the smallest first
    cdef double* lapack
    cdef int[::1] whole
    cdef Py_ssize_t _lay_out(self, double* room) noexcept
    cdef void _sum(self, Py_ssize_t size, Py_ssize_t skipped) noexcept nogil
    cdef void _add(self, Py_ssize_t i) noexcept nogil
    cdef void _keep(self, Py_ssize_t c) noexcept nogil
    cdef void _update(self, Py_ssize_t c, int r) noexcept nogil
    cdef void _cross(self, Py_ssize_t c, int m, int r) noexcept nogil
    cdef inline void _swaps(self, Py_ssize_t c) noexcept nogil
    cdef inline void _take_out(self, Py_ssize_t out) noexcept nogil
    cdef double _least(self, bint vectors) noexcept nogil
    cdef bint _bound_without(self, Py_ssize_t at) noexcept nogil
    cdef Py_ssize_t _next(self, double least) noexcept nogil

@cython.final
cdef class JointClimber(Climber):
    cdef list climbers
    cdef Py_ssize_t[::1] addresses  # (S,) of the climbers: a call takes no reference
    cdef void** members  # the same
    cdef bint least  # the least counts, else the mean
    cdef double[::1] weights  # (S,), as are the next four
    cdef double[::1] scale
    cdef double[::1] shift
    cdef double[::1] phi  # of the chosen
    cdef double[::1] after  # of those after a swap
    cdef double[::1] total  # (WIDE,)
    cdef double[:, ::1] ahead  # (S, groups WIDE) bounds on E in each
    cdef double _join(self, const double* phi) noexcept nogil
    cdef void _totals(self, Py_ssize_t c, bint swaps) noexcept nogil
    cdef Py_ssize_t _best(self, bint swaps, double most) noexcept nogil
    cdef bint _betters(self, Py_ssize_t e, double* least) noexcept nogil

cdef void _weigh(double* into, double* weights, double* rows, Py_ssize_t count) noexcept nogil
cdef void _dots(double* into, double* left, double* right, Py_ssize_t count) noexcept nogil
cdef void _times(double* into, double weight, double* left, double* right, bint turned, int q) noexcept nogil
cdef void _invert(double* matrices, double* det, int q, int wide) noexcept nogil
cdef void _mix(double* into, double weight, double* matrix, double* these, int rows, int q) noexcept nogil
cdef void _lower(double* grown, double* left, double* right, int rows, int q) noexcept nogil
cdef double _largest(double* values) noexcept nogil
cdef Py_ssize_t _best_of(double* gain, double* closed, double most) noexcept nogil
