# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnosis: which effect does the model lack; add it; the error before and after."""

from piezo_ident.diagnosis.diagnose import diagnose
from piezo_ident.diagnosis.results import Diagnosis, DiagnosisSettings

__all__ = ['Diagnosis', 'DiagnosisSettings', 'diagnose']
