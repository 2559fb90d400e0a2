"""Compiled functions: numba's, in 0.6 of the time.

A function that Python calls begins with code that takes apart each array and tuple it is given; compiling that takes
as long as the rest of a short one, and kernels that call it have no use for it. So a kernel is compiled for Python and
for kernels apart, for either when it is first called from there. No machine code is made of what becomes part of
kernels, which takes a tenth of what is left.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import cache, cached_property
from types import FunctionType
from typing import Any

from numba import cfunc, config, typeof, types
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher
from numba.core.typing.templates import Signature

# For compiled functions that make no arrays: of every array that a function is given, in tuples too, numba counts the
# references, which takes longer than what a short function does.
COUNT_NO_REFERENCES = {"_nrt": False}


class _Part(JITCodeLibrary):
    """Code that becomes part of other code."""

    def _finalize_final_module(self) -> None:
        """Leave out what numba does for code that runs: hand it to the machine."""
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return that there is none."""
        return 0

    @property
    def codegen(self) -> _Part:
        """What `set_env` is asked of."""
        return self

    def set_env(self, name: str, env: object) -> None:
        """Leave out what serves to make Python's objects."""

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """Return what is kept for a later run, of which machine code may be made there."""
        return self.serialize_using_bitcode()


class _PartCompiler(Compiler):
    """Numba's compiler, for code that becomes part of other code."""

    def __init__(self, typingctx: Any, targetctx: Any, library: Any, *how: Any) -> None:
        super().__init__(typingctx, targetctx, _Part(targetctx.codegen(), "part"), *how)


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
        options = {**self.targetoptions, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        made = _Compiled(inner, None, options, _PartCompiler)
        if not isinstance(self._cache, NullCache):
            made.enable_caching()
        return made

    @property
    def _numba_type_(self) -> types.Type:
        return types.Dispatcher(self.inward)


def njit(*, cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles functions as numba's of this name does, with its options."""

    def compiled(function: Callable[..., Any]) -> Any:
        if config.DISABLE_JIT:
            return function
        kernel = Kernel(function, None, {"nopython": True, "boundscheck": None, **options})
        if cache:
            kernel.enable_caching()
        return kernel

    return compiled


def by_address(kernel: Callable[..., Any], result: types.Type, *arguments: object) -> Any:
    """Return a kernel for kernels to call by its address, with arguments like these.

    Kernels that call a compiled function hold a copy of it, for which it is compiled again; one that is called by its
    address is compiled once.
    """
    return kernel if config.DISABLE_JIT else _compiled_for(kernel, result(*map(typeof, arguments)))


@cache
def _compiled_for(kernel: Kernel, signature: Signature) -> Any:
    return cfunc(signature, cache=True)(kernel.py_func)
