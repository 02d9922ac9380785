"""Products and inverses of small matrices held by rows; the rule of what is singular.

Nothing here starts a thread of BLAS: the threads of a few microseconds' work wait for a
core where other work is done, a hundred times as long as the work. So a product is made
in parts below the size where BLAS starts them, and factors are our own: LAPACK's start
them from 30 rows on.
"""

from libc.math cimport INFINITY, log, sqrt
from scipy.linalg.cython_blas cimport dgemm

cdef enum:
    UNTHREADED = 240_000  # multiplications up to which BLAS starts no threads

cdef inline void multiply(
    bint turn_a, bint turn_b, int rows, int columns, int inner, double* a, double* b,
    double* out,
) noexcept nogil:
    """``out = a @ b`` (rows, columns), each transposed before where turned."""
    cdef double one = 1.0, zero = 0.0
    cdef int lda = rows if turn_a else inner, ldb = inner if turn_b else columns
    cdef int some = max(1, UNTHREADED // max(1, columns * inner)), first = 0
    while first < rows:
        some = min(some, rows - first)
        dgemm(
            b"T" if turn_b else b"N", b"T" if turn_a else b"N", &columns, &some, &inner,
            &one, b, &ldb, a + (first if turn_a else first * lda), &lda, &zero,
            out + first * columns, &columns,
        )
        first += some

cdef inline double cholesky(
    double* matrix, double* lower, int p, double least
) noexcept nogil:
    """Log det of a positive definite matrix (p, p), and its factor; -inf without one.

    ``lower`` may be the matrix itself; what is right of its diagonal is not touched.
    Pivots are at least ``least``, where that is not zero.
    """
    cdef int a, b, c
    cdef double total, value = 0.0
    for a in range(p):
        for b in range(a + 1):
            total = matrix[a * p + b]
            for c in range(b):
                total -= lower[a * p + c] * lower[b * p + c]
            if a > b:
                lower[a * p + b] = total / lower[b * p + b]
            elif max(total, least) > 0.0:
                total = max(total, least)
                lower[a * p + a] = sqrt(total)
                value += log(total)
            else:
                return -INFINITY
    return value

cdef inline void invert_lower(double* lower, int p) noexcept nogil:
    """A lower triangle (p, p) becomes its own inverse; the rest becomes zero."""
    cdef int a, b, c
    cdef double weight, scale
    for a in range(p):
        scale = 1.0 / lower[a * p + a]
        for c in range(a):
            weight = -scale * lower[a * p + c]
            lower[a * p + c] = 0.0
            for b in range(c + 1):
                lower[a * p + b] += weight * lower[c * p + b]
        lower[a * p + a] = scale
        for b in range(a + 1, p):
            lower[a * p + b] = 0.0

cdef inline double factor(
    double* matrix, double* inverse, double* lower, int p
) noexcept nogil:
    """Log det of a positive definite matrix (p, p), and its inverse; -inf where singular.

    Singular is where a parameter's variance is 1e13 times that with all others known,
    or, of whitened information, 1e13 times that with everything measured. ``lower`` is
    filled with H, ``H.T @ H`` the inverse.
    """
    cdef int a, b, c
    cdef double weight, value = cholesky(matrix, lower, p, 0.0)
    if not value > -INFINITY:
        return value
    invert_lower(lower, p)
    for a in range(p * p):
        inverse[a] = 0.0
    for c in range(p):
        for a in range(c + 1):
            weight = lower[c * p + a]
            for b in range(a + 1):
                inverse[a * p + b] += weight * lower[c * p + b]
    for a in range(p):
        if not inverse[a * p + a] * max(matrix[a * p + a], 1.0) < 1e13:
            return -INFINITY
        for b in range(a):
            inverse[b * p + a] = inverse[a * p + b]
    return value
