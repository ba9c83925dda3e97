"""Types of arguments and results, checked again and again only where they differ.

A search calls the same small functions some 10,000 times. To check all of these calls takes longer
than they do. So calls whose arrays have the same shapes and types are checked a few times in each
test; what is new is always checked. A function that is defined within another is made at each call
of that one: its check is made once.
"""

from collections import Counter
from typing import Any

import jax
import numpy as np
from beartype import beartype, BeartypeConf, BeartypeStrategy


CALLS = 10  # of a function with arguments of the same kinds that are checked in a test
_ARRAYS = (np.ndarray, np.generic, jax.Array)
_LONG = 16  # items of a list, beyond which its length stands for it
_tests = 0  # that have begun in this process
_is_array: dict[type, bool] = {}
_checks: dict[tuple, Any] = {}  # by module, name, parameters and their types
_of_all_items = beartype(conf=BeartypeConf(strategy=BeartypeStrategy.On))


def begin_test():
    """Let all calls be checked again."""
    global _tests
    _tests += 1


def checked(function):
    """`function` for its checks only, as jaxtyping calls it: made when it is called first."""
    types, code = function.__annotations__, function.__code__
    if all(kind is Any for kind in types.values()):
        return function
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    key = (function.__module__, function.__qualname__, code.co_varnames, counts, *types.items())
    try:
        if key not in _checks:
            _checks[key] = _check_of(function)
        return _checks[key]
    except TypeError:  # a type without a hash
        return _check_of(function)


def _check_of(function):
    check, test, calls = None, 0, Counter()

    def check_first(*args, **kwargs):
        nonlocal check, test
        if test != _tests:
            test = _tests
            calls.clear()
        kinds = (*map(_kind, args), *kwargs, *map(_kind, kwargs.values()))
        if calls[kinds] < CALLS:
            calls[kinds] += 1
            check = check or _of_all_items(function)
            check(*args, **kwargs)

    return check_first


def _kind(value):
    """What a check of `value` depends on."""
    kind = type(value)
    is_array = _is_array.get(kind)
    if is_array is None:  # to ask JAX takes longer than all else here
        is_array = _is_array[kind] = isinstance(value, _ARRAYS)
    if is_array:
        return kind, value.shape, value.dtype
    if kind is tuple or kind is list:
        return kind, len(value), *map(_kind, value[:_LONG])
    return (kind, value) if kind is str else kind
