# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What all tests share: one thread for the linear algebra, set before NumPy is imported."""

import os
import signal

# the matrices are narrow: two threads that share their cores with other work wait for each other
# (identification of 100,000 samples: 0.8 s with one thread, 7 to 45 s with two on a busy machine)
for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(name, '1')

# a shell that starts the tests in the background has them ignore Ctrl-C, which is tested here
signal.signal(signal.SIGINT, signal.default_int_handler)
