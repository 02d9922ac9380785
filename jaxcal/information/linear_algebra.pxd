"""Products and inverses of small matrices held by rows; the rule of what is singular.

Of a symmetric matrix the lower triangle is read, and both are written.

Nothing here starts a thread of BLAS: the threads of a few microseconds' work wait for a
core where other work is done, a hundred times as long as the work. So a product is made
in parts below the size where BLAS starts them, and factors are our own: LAPACK's start
them from 30 rows on. Of the smallest products a call of BLAS costs more than they do.
"""

from libc.math cimport INFINITY, log, sqrt
from libc.string cimport memcpy
from scipy.linalg.cython_blas cimport dgemm
from scipy.linalg.cython_lapack cimport dsyevd

cdef enum:
    UNTHREADED = 240_000  # multiplications up to which BLAS starts no threads
    SMALL = 300  # multiplications that take less than a call of BLAS

cdef inline double* take(double** room, Py_ssize_t count) noexcept nogil:
    """Where the next ``count`` numbers of the room are; it begins after them then."""
    cdef double* here = room[0]
    room[0] = <double*> (<size_t> here + count * sizeof(double))
    return here

cdef inline void copy(
    double* into, const double* source, Py_ssize_t count
) noexcept nogil:
    memcpy(into, source, count * sizeof(double))

cdef inline double dot(const double* x, const double* y, int count) noexcept nogil:
    """``x @ y``, in eight sums at a time."""
    cdef double[8] sums
    cdef double total = 0.0
    cdef int a = 0, b
    if count >= 16:
        for b in range(8):
            sums[b] = 0.0
        while a + 8 <= count:
            for b in range(8):
                sums[b] += x[a + b] * y[a + b]
            a += 8
        for b in range(4):
            total += sums[b] + sums[b + 4]
    while a < count:
        total += x[a] * y[a]
        a += 1
    return total

cdef inline void multiply(
    bint turn_a, bint turn_b, int rows, int columns, int inner, const double* a,
    const double* b, double* out,
) noexcept nogil:
    """``out = a @ b`` (rows, columns), each transposed before where turned."""
    cdef double one = 1.0, zero = 0.0
    cdef int lda = rows if turn_a else inner, ldb = inner if turn_b else columns
    cdef int some = max(1, UNTHREADED // max(1, columns * inner)), first = 0
    cdef int r, c, e
    cdef double weight
    cdef double* row
    if rows * columns * inner <= SMALL:
        for r in range(rows):
            row = out + r * columns
            for c in range(columns):
                row[c] = 0.0
            for e in range(inner):
                weight = a[e * lda + r] if turn_a else a[r * lda + e]
                if turn_b:
                    for c in range(columns):
                        row[c] += weight * b[c * ldb + e]
                else:
                    for c in range(columns):
                        row[c] += weight * b[e * ldb + c]
        return
    while first < rows:
        some = min(some, rows - first)
        dgemm(
            b"T" if turn_b else b"N", b"T" if turn_a else b"N", &columns, &some, &inner,
            &one, <double*> b, &ldb,
            <double*> a + (first if turn_a else first * lda), &lda, &zero,
            out + first * columns, &columns,
        )
        first += some

cdef inline double cholesky(
    double* matrix, double* lower, int p, double least
) noexcept nogil:
    """Log det of a positive definite matrix (p, p), and its factor; -inf without one.

    ``lower`` holds the factor with the reciprocals of its diagonal, may be the matrix
    itself, and what is right of its diagonal is not touched. Pivots are at least
    ``least``, where that is not zero.
    """
    cdef int a, b
    cdef double total, value = 0.0, product = 1.0
    for a in range(p):
        for b in range(a + 1):
            total = matrix[a * p + b] - dot(lower + a * p, lower + b * p, b)
            if a > b:
                lower[a * p + b] = total * lower[b * p + b]
            elif max(total, least) > 0.0:
                total = max(total, least)
                lower[a * p + a] = 1.0 / sqrt(total)
                if 1e-100 < product * total < 1e100:
                    product *= total
                else:
                    value += log(product) + log(total)
                    product = 1.0
            else:
                return -INFINITY
    return value + log(product)

cdef inline void invert_lower(double* lower, int p) noexcept nogil:
    """A factor of ``cholesky`` (p, p) becomes its inverse; the rest becomes zero."""
    cdef int a, b, c
    cdef double weight, scale
    for a in range(p):
        scale = lower[a * p + a]
        for c in range(a):
            weight = -scale * lower[a * p + c]
            lower[a * p + c] = 0.0
            for b in range(c + 1):
                lower[a * p + b] += weight * lower[c * p + b]
        for b in range(a + 1, p):
            lower[a * p + b] = 0.0

cdef inline double factor(
    double* matrix, double* inverse, double* lower, int p
) noexcept nogil:
    """Log det of a positive definite matrix (p, p), and its inverse; -inf where singular.

    Singular is where a parameter's variance is 1e13 times that with all others known:
    in the matrix's own scale. ``lower`` is filled with H, ``H.T @ H`` the inverse.
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
        if not inverse[a * p + a] * matrix[a * p + a] < 1e13:
            return -INFINITY
        for b in range(a):
            inverse[b * p + a] = inverse[a * p + b]
    return value

cdef inline void add(
    double* gram, double weight, const double* rows, int q, int p
) noexcept nogil:
    """``gram += weight rows.T @ rows`` of (p, p) and (q, p), in its lower triangle."""
    cdef int a, b, r
    cdef double scaled
    for r in range(q):
        for a in range(p):
            scaled = weight * rows[r * p + a]
            for b in range(a + 1):
                gram[a * p + b] += scaled * rows[r * p + b]

cdef inline void eigen(
    double* matrix, double* values, double* room, int[::1] whole, int p,
    bint vectors=True,
) noexcept nogil:
    """Eigenvalues of a symmetric matrix, smallest first, and eigenvectors in its rows.

    ``room`` holds 1 + 6 p + 2 p^2 numbers, ``whole`` 3 + 5 p. Without ``vectors`` the
    matrix is spoiled.
    """
    cdef int info = 0, size = 1 + 6 * p + 2 * p * p, wholes = whole.shape[0]
    dsyevd(
        b"V" if vectors else b"N", b"L", &p, matrix, &p, values, room, &size, &whole[0], &wholes, &info
    )

cdef inline double covariance(
    bint det, const double* root, double* inverse, int s, int p, double* half,
    double* solved, double* small, double* other, double* lower, double* gradient,
) noexcept nogil:
    """-log det of V = C W C.T, or minus its trace, and G = W C.T V^-1 C W, or W C.T C W.

    G is the gradient by the information, whose inverse is W. ``half`` (s, p) is filled
    with C W; ``solved`` (s, p), ``small``, ``other``, ``lower`` (s, s) are room.
    """
    cdef double value
    multiply(False, False, s, p, p, root, inverse, half)
    if not det:
        multiply(True, False, p, p, s, half, half, gradient)
        return -dot(half, root, s * p)
    multiply(False, True, s, s, p, half, root, small)
    value = -factor(small, other, lower, s)
    if not value < INFINITY:
        return -INFINITY
    multiply(False, False, s, p, s, other, half, solved)
    multiply(True, False, p, p, s, half, solved, gradient)
    return value
