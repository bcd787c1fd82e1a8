# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``python -m piezo_ident.nodes.identifier``."""

from piezo_ident.nodes.identifier import main

if __name__ == '__main__':
    raise SystemExit(main())
