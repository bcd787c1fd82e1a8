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

"""Diagnosis: which effect does the model lack; add it; the error before and after."""

from piezo_ident.diagnosis.procedure import diagnose
from piezo_ident.diagnosis.results import Diagnosis, DiagnosisSettings

__all__ = ['Diagnosis', 'DiagnosisSettings', 'diagnose']
