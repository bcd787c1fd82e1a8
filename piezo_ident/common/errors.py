# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Exceptions of the package: each message names the fault, its place, and its cure."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
import dataclasses
import difflib
from numbers import Integral, Real
from typing import Any

#: types of numbers as dataclasses declare them
_NUMBERS = {'int': (Integral, 'a whole number'), 'float': (Real, 'a number')}
#: longest message [characters]: it may quote a file
_LONGEST = 4000


def printable(text: str) -> str:
    r"""
    Write a text in one line without control characters, which could steer a terminal.

    >>> printable('a\tlabel\x1b[2J')
    'a label?[2J'
    """
    return ''.join(c if c.isprintable() else ' ' if c.isspace() else '?' for c in text)


class PiezoIdentError(Exception):
    """
    Base of every error that this package raises on purpose.

    Its message is one line without control characters, which could steer a terminal.  Its
    `options` are an addition to the command line, as it is typed, that mends the error.
    """

    def __init__(self, message: str = '', *, options: str = '') -> None:
        super().__init__(printable(message)[:_LONGEST])
        self.options = options if options.isprintable() else ''


class DataError(PiezoIdentError):
    """Measured data that cannot be used as they are."""


class OrderError(DataError):
    """Samples whose times are in no order: the fault with its place, and the cure of a table."""

    def __init__(self, fact: str, cure: str) -> None:
        super().__init__(f'{fact}; {cure}')
        self.fact = fact


class ConfigError(PiezoIdentError):
    """A configuration, program or option that cannot be followed."""


class ModelError(PiezoIdentError):
    """A model, or a model file, that is not usable."""


class IdentificationError(PiezoIdentError):
    """Sound data that lack the information for a result."""


class Cancelled(PiezoIdentError):
    """The work was stopped on request; nothing was written."""


@contextmanager
def naming(*names: str, model: str = '') -> Iterator[None]:
    """
    Put the names of the inputs before messages without one of these names.

    A ModelError gets the name of the `model` alone, if it is given.
    """
    try:
        yield
    except PiezoIdentError as error:
        if model and isinstance(error, ModelError):
            names = (model,)
        if any(name in str(error) for name in names):
            raise
        text = f'{", ".join(names)}: {error}'
        raise type(error)(text, options=error.options) from None


def expect(value: object, kind: type | tuple[type, ...], where: str, hint: str) -> None:
    """Refuse an argument of another type with a DataError that names both types and the cure."""
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        names = ' or '.join(k.__name__ for k in kinds)
        raise DataError(f'{where}: expected {names}, got {type(value).__name__}; {hint}')


def expect_numbers(settings: Any) -> None:
    """Refuse fields of a dataclass, declared as int or float, of another type by a ConfigError."""
    for field in dataclasses.fields(settings):
        declared, _, optional = str(field.type).partition(' | ')
        kind, noun = _NUMBERS.get(declared, (object, ''))
        value = getattr(settings, field.name)
        if not isinstance(value, kind) and not (optional and value is None):
            raise ConfigError(f'{field.name} must be {noun}, got {value!r}')


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Guess the known word that was meant; an empty text if none resembles `word`."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f'did you mean {close[0]}?' if close else ''
