# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The command line: ``piezo_ident VERB ...``."""

from piezo_ident.cli.main import main

__all__ = ['main']
