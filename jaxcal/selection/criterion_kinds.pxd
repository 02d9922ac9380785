"""Forms of a criterion phi(M) of V = C M^-1 C.T, as ``Criterion.form`` names them."""

cdef enum:
    DET  # -log det V, C square: log det M but for a constant
    SUBSET  # -log det V of fewer combinations than parameters
    TRACE  # -trace V
    LEAST  # 1 / largest eigenvalue of V
