"""One thread in each BLAS before numpy is loaded: the matrices here are small, and threads cost more than they give."""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
