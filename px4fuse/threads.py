"""One thread for linear algebra: the matrices here are small, and more threads only wait."""

# Read by libraries as they are loaded, before any code of ours runs
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
}
