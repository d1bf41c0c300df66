"""The options of numba for kernels, and the compiler pipeline of functions that only kernels call.

A kernel contains its callees. To optimise and translate a callee separately, and again in each caller, took half of the
compilation time. So the compilation of callees stops before these steps.
"""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

from optloc.kernels.no_refcount_pass import borrowing


def options(*, callee: bool, taken_in: bool) -> dict[str, Any]:
    """Return the options of numba's `njit` for a kernel.

    Without an entry point for C, which no caller uses, compilation takes a fifth less time. LLVM inlines functions,
    because numba's method of joining sources takes longer.
    """
    common = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "forceinline": taken_in}
    return common | ({"no_cpython_wrapper": True, "pipeline_class": callee_compiler()} if callee else {})


@cache
def callee_library() -> Any:
    """Return numba's type for the code of a callee, which is neither optimised nor translated."""
    from llvmlite import binding
    from numba.core import codegen

    llvm: Any = binding
    numba: Any = codegen

    class Callee(numba.JITCodeLibrary):  # type: ignore[misc]
        # The engine contains no code of a callee, so an environment cannot be set.
        codegen = SimpleNamespace(set_env=lambda name, environment: None)

        def _optimize_final_module(self) -> None:
            pass

        def _finalize_final_module(self) -> None:
            self._finalize_dynamic_globals()
            self._finalized = True

        def get_pointer_to_function(self, name: str) -> int:
            return 0

        def serialize_using_object_code(self) -> Any:
            return self.serialize_using_bitcode()

        @classmethod
        def read(cls, engine: Any, stored: tuple[str, str, bytes]) -> Any:
            """Return a stored library, loaded into the engine of this process."""
            made = cls(engine, stored[0])
            made._final_module = llvm.parse_bitcode(stored[2])
            made._finalize_final_module()
            return made

    return Callee


@cache
def callee_compiler() -> Any:
    """Return numba's compiler of functions that only kernels call, for the option `pipeline_class`."""
    from numba.core import compiler
    from numba.core.typed_passes import AnnotateTypes

    numba: Any = compiler

    class Callees(numba.Compiler):  # type: ignore[misc]
        def define_pipelines(self) -> Any:
            state = self.state
            state.library = callee_library()(state.targetctx.codegen(), state.func_id.func_qualname)
            pipelines = super().define_pipelines()
            for pipeline in pipelines:
                pipeline.add_pass_after(borrowing(), AnnotateTypes)
                pipeline.finalize()
            return pipelines

    return Callees
