"""Environment variables for single-threaded linear algebra.

The matrices are small, so more threads would mostly wait for each other.
"""

# Libraries read these variables when they are loaded
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
}
