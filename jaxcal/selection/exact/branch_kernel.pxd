from jaxcal.watch cimport Watch


cdef class Search:
    cdef int kind
    cdef int rank  # of one block, at most
    cdef int q, p, s
    cdef Py_ssize_t count  # M
    cdef double k
    cdef double useful  # a bound above it is sharpened although the time is over
    cdef double[:, ::1] best_counts  # (best, M)
    cdef double[::1] best_values  # (best,), the best first
    cdef Py_ssize_t[::1] order  # (best,) the row of ``best_counts`` of each
    cdef double[::1] room  # which holds all that is a pointer below
    cdef int most_moved  # counts of a Newton step
    cdef bint lent  # the largest work space is that of a JointSearch
    cdef double* blocks  # (M, q, p), as given or ``reduced``, where p is less
    cdef double* given
    cdef double* reduced
    cdef int dimensions  # p of the blocks as given
    cdef bint reducible
    cdef double* prior  # (p, p)
    cdef double* root  # C (s, p)
    cdef double* known  # (p, p) P, the prior and what the node has chosen
    cdef double* rest  # (p, p) N, the information of the other counts
    cdef double* gram  # (p, p) M = P + N
    cdef double* gradient  # (p, p) G
    cdef double* inverse  # (p, p) W
    cdef double* other  # (p, p) G of the covariance alone
    cdef double* half  # (p, p) H with H P H.T = I, lower triangular
    cdef double* basis  # (p, p) rows y with G = sum of slopes y y.T
    cdef double* bend  # (p, p) curvature in that basis
    cdef double* lines  # (p, p) eigenvectors that make up C, in rows
    cdef double* share  # (p, p) C of RANK_TRACE, of which ``size`` rows count
    cdef double* vectors  # (p, p) work space, as are the next four
    cdef double* reach
    cdef double* scaled
    cdef double* small
    cdef double* spare
    cdef double* values  # (p,) eigenvalues
    cdef double* slopes
    cdef double* own
    cdef double* tail  # (p,) direction of the last, rank-one part of the bend
    cdef double* weights  # (p,) eigenvalues u of U, smallest first
    cdef double* lapack
    cdef int[::1] whole
    cdef int size
    cdef int now  # the kind of the bound where the relaxation ended
    cdef int places  # t
    cdef double tail_weight
    cdef double smoothing  # b of E
    cdef double constant  # of the bounds by rank
    cdef double mu
    cdef double shares  # sum of 1 / (1 + l) over the places
    cdef double linear  # the bound by the leverages where the climb ended
    cdef double base  # what the linear gain is added to for a bound
    cdef double cut  # the multiplier of the bound
    cdef double* leverage  # (M,)
    cdef double* wish  # (M,)
    cdef Py_ssize_t[::1] open  # (M,) counts that are not fixed, of which ``opened`` count
    cdef Py_ssize_t opened
    cdef Py_ssize_t[::1] which  # (m,) counts that a Newton step moves
    cdef Py_ssize_t[::1] free
    cdef int[::1] side
    cdef double* picked  # (m q, p) their blocks, and turned by a matrix
    cdef double* turned
    cdef double* crossed  # (m q)^2, or (m, p (p + 1) / 2) twice
    cdef double* bent
    cdef double* curvature  # (m, m)
    cdef double* face  # (m, m)
    cdef double* ends  # (m,), as are the rest
    cdef double* move
    cdef double* before
    cdef double* slope
    cdef double* least
    cdef double* most
    cdef double* right  # (2, m)
    cdef double* node  # (3, M)
    cdef bint packs  # B.T B of every candidate is kept
    cdef int triangle  # p (p + 1) / 2
    cdef double* packed  # (triangle,) work space
    cdef double* squares  # (M, triangle) where it packs
    cdef Watch watch
    cdef bint ruled  # whether rules of the counts are given, as the next five say
    cdef const double[:, ::1] rules  # (r, M)
    cdef const double[::1] most_of  # (r,)
    cdef const Py_ssize_t[:, ::1] order_of  # (r, M)
    cdef double[::1] price  # (M,) what a count pays
    cdef double paid  # beside that
    cdef double _priced(self, double value, const double* c) noexcept nogil
    cdef bint _keeps(self, const double* low, const double* high) noexcept nogil
    cdef Py_ssize_t _lay_out(self, double* room) noexcept
    cdef void _pack(self, const double* matrix, double* into, double times) noexcept nogil
    cdef void _sum(self, const double* low, const double* counts, const double* start, double* gram) noexcept nogil
    cdef double _evaluate(self, int kind) noexcept nogil
    cdef double _rounded(self, double share) noexcept nogil
    cdef double _covariance(self, bint det, double* root, int s, double* gradient) noexcept nogil
    cdef double _weakest(self) noexcept nogil
    cdef double _shared_out(self, int kind) noexcept nogil
    cdef void _bends(self) noexcept nogil
    cdef int _kind_of(self, const double* low) noexcept nogil
    cdef void _reduce(self, int kind, const double* low, const double* high) noexcept nogil
    cdef void _weigh(self) noexcept nogil
    cdef bint _choose_mu(self, int place) noexcept nogil
    cdef int _best_place(self) noexcept nogil
    cdef void _turn(self, int m, double* matrix, bint turn) noexcept nogil
    cdef void _hessian(self, int kind, int m) noexcept nogil
    cdef void _spectral_hessian(self, int m) noexcept nogil
    cdef void _leverages(self) noexcept nogil
    cdef double _linear_gain(self, const double* low, const double* high, const double* c) noexcept nogil
    cdef int _working_set(self, const double* low, const double* high, const double* c) noexcept nogil
    cdef void _two_sided(self, int size) noexcept nogil
    cdef double _solve(self, int m, int size) noexcept nogil
    cdef void _quadratic_step(self, int m) noexcept nogil
    cdef void _gather(self, const double* low, const double* c) noexcept nogil
    cdef double _at(self, int kind, const double* low, const double* c) noexcept nogil
    cdef void _spread(self, const double* low, const double* high, double* c) noexcept nogil
    cdef double _relax(self, int kind, double* low, double* high, double* c, double goal, double share) except? -1.0 nogil
    cdef double _begin(self, int kind, const double* low, const double* high, double* c) noexcept nogil
    cdef double _step(self, int kind, const double* low, const double* high, double* c, double value) noexcept nogil
    cdef double _worth(self, const double* counts) noexcept nogil
    cdef void _gather_whole(self, const double* counts) noexcept nogil
    cdef void _offer(self, const double* counts) noexcept nogil
    cdef bint _balance(self, const double* low, const double* high, double* c) noexcept nogil
    cdef void _stiffen(self, const double* c) noexcept nogil
    cdef Py_ssize_t _process(self, double* low, double* high, double* c, double slack, double share, double* bound) except -2 nogil


cdef class JointSearch(Search):
    cdef list keep  # a Search of each scenario
    cdef Py_ssize_t[::1] addresses  # (S,) of them: a call takes no reference
    cdef void** members  # the same
    cdef unsigned char[::1] sample  # (S,) whether curvature is of it
    cdef Py_ssize_t turn  # where the sample begins
    cdef bint least_counts  # the least, else the mean
    cdef double[::1] weights_of  # (S,), as are the rest
    cdef double[::1] scale
    cdef double[::1] shift
    cdef double[::1] mixture  # of sum 1: the weights, or of the smoothed least
    cdef double[::1] worth  # scale phi + shift
    cdef double[::1] bases  # what the bounds of the scenarios add up from
    cdef int _kind_of(self, const double* low) noexcept nogil
    cdef void _gather(self, const double* low, const double* c) noexcept nogil
    cdef void _gather_whole(self, const double* counts) noexcept nogil
    cdef double _evaluate(self, int kind) noexcept nogil
    cdef void _leverages(self) noexcept nogil
    cdef void _hessian(self, int kind, int m) noexcept nogil
