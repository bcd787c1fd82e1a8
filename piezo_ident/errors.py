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

"""The package's own exceptions: each message says what is wrong, where, and what to do."""

#: what a message quotes may come from a file, and be of any length
_LONGEST = 4000


class PiezoIdentError(Exception):
    """
    Base of every error that this package raises on purpose.

    Its message is one line without control characters, which could steer a terminal, whatever
    names of a file it quotes.
    """

    def __init__(self, message: str = '') -> None:
        shown = (c if c.isprintable() else ' ' if c.isspace() else '?' for c in message)
        super().__init__(''.join(shown)[:_LONGEST])


class DataError(PiezoIdentError):
    """Measured data that cannot be used as they are."""


class ConfigError(PiezoIdentError):
    """A configuration, programme or option that cannot be followed."""


class ModelError(PiezoIdentError):
    """A model, or a model file, that is not usable."""


class IdentificationError(PiezoIdentError):
    """Data that are sound but do not carry what was asked of them."""


class Cancelled(PiezoIdentError):
    """The work was stopped on request; nothing was written."""
