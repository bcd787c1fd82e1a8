# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``python -m piezo_ident``."""

import sys

from piezo_ident.cli import main

if __name__ == '__main__':
    sys.exit(main())
