# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What all tests share: one thread for the linear algebra, set before NumPy is imported."""

import os
import signal

# the matrices are narrow: two threads that share their cores with other work wait for each other
# (identification of 100,000 samples: 0.8 s with one thread, 7 to 45 s with two on a busy machine)
for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(name, '1')

# a shell that starts the tests in the background has them ignore Ctrl-C, which is tested here
signal.signal(signal.SIGINT, signal.default_int_handler)
