from jaxcal.watch cimport Watch


cdef class Search:
    cdef int kind
    cdef int rank  # of one block, at most
    cdef double k
    cdef double[:, :, ::1] blocks  # (M, q, p)
    cdef double[:, ::1] prior  # (p, p)
    cdef double[:, ::1] root  # C (s, p)
    cdef double[:, ::1] known  # (p, p) P, the prior and what the node has chosen
    cdef double[:, ::1] rest  # (p, p) N, the information of the other counts
    cdef double[:, ::1] gram  # (p, p) M = P + N
    cdef double[:, ::1] gradient  # (p, p) G
    cdef double[:, ::1] inverse  # (p, p) W
    cdef double[:, ::1] other  # (p, p) G of the covariance alone
    cdef double[:, ::1] half  # (p, p) H with H P H.T = I, lower triangular
    cdef double[:, ::1] basis  # (p, p) rows y with G = sum of slopes y y.T
    cdef double[:, ::1] bend  # (p, p) curvature in that basis
    cdef double[:, ::1] lines  # (p, p) eigenvectors that make up C, in rows
    cdef double[:, ::1] share  # (p, p) C of RANK_TRACE, of which ``size`` rows count
    cdef double[:, ::1] vectors  # (p, p) work space, as are the next four
    cdef double[:, ::1] reach
    cdef double[:, ::1] scaled
    cdef double[:, ::1] small
    cdef double[::1] values  # (p,) eigenvalues
    cdef double[::1] slopes
    cdef double[::1] own
    cdef double[::1] tail  # (p,) direction of the last, rank-one part of the bend
    cdef double[::1] weights  # (p,) eigenvalues u of U, smallest first
    cdef double[::1] lapack
    cdef int[::1] whole
    cdef int size
    cdef int places  # t
    cdef double tail_weight
    cdef double smoothing  # b of E
    cdef double constant  # of the bounds by rank
    cdef double mu
    cdef double shares  # sum of 1 / (1 + l) over the places
    cdef double base  # what the linear gain is added to for a bound
    cdef double cut  # the multiplier of the bound
    cdef double[::1] leverage  # (M,)
    cdef double[::1] wish  # (M,)
    cdef Py_ssize_t[::1] which  # (m,) counts that a Newton step moves
    cdef Py_ssize_t[::1] free
    cdef int[::1] side
    cdef double[:, ::1] picked  # (m q, p) their blocks, and turned by a matrix
    cdef double[:, ::1] turned
    cdef double[::1] crossed  # (m q)^2, or (m, p (p + 1) / 2) twice
    cdef double[::1] bent
    cdef double[::1] curvature  # (m, m)
    cdef double[::1] face  # (m, m)
    cdef double[::1] ends  # (m,), as are the rest
    cdef double[::1] move
    cdef double[::1] before
    cdef double[::1] slope
    cdef double[::1] least
    cdef double[::1] most
    cdef double[::1] right  # (2, m)
    cdef double[:, ::1] node  # (3, M)
    cdef Watch watch
    cdef void _sum(self, double* low, double[::1] counts, double[:, ::1] start, double[:, ::1] gram) noexcept nogil
    cdef double _evaluate(self, int kind) noexcept nogil
    cdef double _covariance(self, int kind, double[:, ::1] root, int s, double[:, ::1] gradient) noexcept nogil
    cdef void _eigen(self) noexcept nogil
    cdef double _weakest(self) noexcept nogil
    cdef double _shared_out(self, int kind) noexcept nogil
    cdef double _spectrum(self, int kind) noexcept nogil
    cdef int _kind_of(self, double[::1] low) noexcept nogil
    cdef void _weigh(self) noexcept nogil
    cdef bint _choose_mu(self, int place) noexcept nogil
    cdef int _best_place(self) noexcept nogil
    cdef void _turn(self, int m, double[:, ::1] matrix, bint turn) noexcept nogil
    cdef void _hessian(self, int kind, int m) noexcept nogil
    cdef void _spectral_hessian(self, int m) noexcept nogil
    cdef void _leverages(self, double[::1] low, double[::1] high) noexcept nogil
    cdef double _linear_gain(self, double[::1] low, double[::1] high, double[::1] c) noexcept nogil
    cdef int _working_set(self, double[::1] low, double[::1] high, double[::1] c) noexcept nogil
    cdef double _solve(self, int m, int size) noexcept nogil
    cdef void _quadratic_step(self, int m) noexcept nogil
    cdef double _at(self, int kind, double[::1] low, double[::1] c) noexcept nogil
    cdef void _spread(self, double[::1] low, double[::1] high, double[::1] c) noexcept nogil
    cdef double _relax(self, int kind, double[::1] low, double[::1] high, double[::1] c, double goal, double share) except -1.0 nogil
    cdef double _value_of(self, double[::1] counts) noexcept nogil
    cdef void _offer(self, double[::1] counts, double[:, ::1] best_counts, double[::1] best_values) noexcept nogil
    cdef object _offer_near(self, double[::1] low, double[::1] high, double[::1] counts, double[:, ::1] best_counts, double[::1] best_values)
    cdef bint _balance(self, double[::1] low, double[::1] high, double[::1] c) noexcept nogil
    cdef Py_ssize_t _process(self, double[::1] low, double[::1] high, double[::1] c, double slack, double share, double[:, ::1] best_counts, double[::1] best_values, double* bound) except -2 nogil
    cdef int _run(self, double[:, :, ::1] nodes, double[::1] bounds, Py_ssize_t* size, Py_ssize_t* done, double[:, ::1] best_counts, double[::1] best_values, double slack, Py_ssize_t widest, Py_ssize_t tries, double slope, double shift)
