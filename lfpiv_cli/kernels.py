"""Compiled functions: numba's, which take less time to compile.

A function that Python calls begins with code that takes apart each array and tuple it is given; compiling that takes
as long as the rest of a short one, and kernels that call it have no use for it. So a kernel is compiled for Python and
for kernels apart, for either when it is first called from there.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import cache, cached_property
from types import FunctionType
from typing import Any

from numba import cfunc, config, typeof, types
from numba.core.caching import NullCache
from numba.core.registry import CPUDispatcher
from numba.core.typing.templates import Signature

# For compiled functions that make no arrays: of every array that a function is given, in tuples too, numba counts the
# references, which takes longer than what a short function does. One that returns arrays is called by its like alone:
# others would count down what it has not counted up, and the arrays would be gone while they are in use. One that makes
# arrays and is called by one that counts none says so.
COUNT_NO_REFERENCES, COUNT_REFERENCES = {"_nrt": False}, {"_nrt": True}
# For those that are called once or twice for each particle with all that a view holds: to hand over its two hundred
# numbers took a tenth of the time of a response.
IN_PLACE: dict[str, Any] = {"cache": True, "forceinline": True, **COUNT_NO_REFERENCES}


class _Compiled(CPUDispatcher):
    """A compiled function, with no search for unused objects while it is compiled, which takes a tenth of that."""

    def compile(self, sig: Any) -> Any:
        collects = gc.isenabled()
        gc.disable()
        try:
            return super().compile(sig)
        finally:
            if collects:
                gc.enable()


class Kernel(_Compiled):
    """A compiled function as Python calls it; `inward` is the same as kernels do."""

    @cached_property
    def inward(self) -> _Compiled:
        """What kernels call, under a name of its own as compiled code is kept by names; Python cannot call it."""
        outer = self.py_func
        inner = FunctionType(outer.__code__, outer.__globals__, outer.__name__, outer.__defaults__, outer.__closure__)
        inner.__qualname__, inner.__kwdefaults__ = f"{outer.__qualname__}.inward", outer.__kwdefaults__
        made = _Compiled(inner, None, {**self.targetoptions, "no_cpython_wrapper": True, "no_cfunc_wrapper": True})
        if not isinstance(self._cache, NullCache):
            made.enable_caching()
        return made

    @property
    def _numba_type_(self) -> types.Type:
        return types.Dispatcher(self.inward)


def njit(*, cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles functions as numba's of this name does, with its options.

    Raises
    ------
    TypeError : twice for one function: a function that was put below another's decorator leaves that to Python
    """

    def compiled(function: Callable[..., Any]) -> Any:
        if isinstance(function, CPUDispatcher):
            raise TypeError(f"{function.__name__}: compiled twice; one of the decorators is another function's")
        if config.DISABLE_JIT:
            return function
        kernel = Kernel(function, None, {"nopython": True, "boundscheck": None, **options})
        if cache:
            kernel.enable_caching()
        return kernel

    return compiled


def for_types_of(kernel: Callable[..., Any], *arguments: object) -> Callable[..., Any]:
    """Return what calls a kernel with arguments of the same types as these, which are not asked for theirs each time.

    Of a view and what holds it that takes a tenth of a millisecond, in which no other thread calls anything.
    """
    if not isinstance(kernel, Kernel):
        return kernel
    entry: Callable[..., Any] = kernel.compile(tuple(map(kernel.typeof_pyval, arguments)))
    return entry


def by_address(kernel: Callable[..., Any], result: types.Type, *arguments: object) -> Any:
    """Return a kernel for kernels to call by its address, with arguments like these.

    Kernels that call a compiled function hold a copy of it, for which it is compiled again; one that is called by its
    address is compiled once.
    """
    return kernel if config.DISABLE_JIT else _compiled_for(kernel, result(*map(typeof, arguments)))


@cache
def _compiled_for(kernel: Kernel, signature: Signature) -> Any:
    references = {key: kernel.targetoptions[key] for key in COUNT_NO_REFERENCES if key in kernel.targetoptions}
    return cfunc(signature, cache=True, **references)(kernel.py_func)
