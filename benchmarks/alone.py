# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One thread of BLAS, for whoever imports this before NumPy.

Tall, narrow factorisations only get slower on more, and two processes would wait for each other.
"""

import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
