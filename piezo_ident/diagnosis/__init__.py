# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Find the effect that a model lacks, add it, and compare the errors before and after."""

from piezo_ident.diagnosis.diagnose import diagnose
from piezo_ident.diagnosis.results import Diagnosis, DiagnosisSettings

__all__ = ['Diagnosis', 'DiagnosisSettings', 'diagnose']
