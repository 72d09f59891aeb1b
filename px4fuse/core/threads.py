"""Environment variables that limit linear algebra libraries to one thread.

Several threads are slower for the small matrices of px4fuse.
"""

# Set these variables before the linear algebra libraries are loaded
ONE_THREAD_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
}
