"""Kernels: functions of arrays as machine code, made once by numba and kept in the user's cache.

A kernel is written as loops next to its NumPy equivalent, which tests compare it with and which
takes its place where numba cannot be imported. Loading kept code takes LLVM alone and 30 ms; numba
itself, half a second in every process, is imported only to make it. The code depends on its module,
the versions and the processor (``NUMBA_CPU_NAME=generic``: on none in particular). It adds in the
order that is written, so that a machine gives the same bytes each time.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.files import cache_root, cached, keep_cached

_NUMBERS: dict[str, Any] = {"i8": ctypes.c_int64, "f8": ctypes.c_double}
_STATUS = ctypes.create_string_buffer(16)  # of numba's calls: a result and an exception, unused
KERNELS: list[Kernel] = []  # of all imported modules


class Kernel:
    """A function of arrays, in machine code; what it finds goes into arrays that it is given."""

    def __init__(
        self, code: Callable[..., None], numpy: Callable[..., None], kinds: str, *uses: Any
    ) -> None:
        """Nothing is made yet.

        Args:
            code: the loops. They make no array and raise nothing.
            numpy: the same on whole arrays.
            kinds: of the arguments, as numba writes them: ``"f4[:,::1] f8[::1] i8 f8"``.
            uses: functions that the loops call.
        """
        self.numpy = numpy
        self._code, self._kinds, self._uses = code, kinds.split(), uses
        self._call: Any = None
        self._engine: Any = None  # the code is in its memory
        KERNELS.append(self)

    def __call__(self, *values: Any) -> None:
        """Calls the machine code; loads or makes it first."""
        if self._call is None:
            self.load()
        if self._engine is None:
            self.numpy(*values)
            return
        # numba hands over an array as owner, parent, size, item size, data, shape and strides.
        start = ctypes.addressof(_STATUS)
        flat, kept = [start, start + 8], []
        for kind, value in zip(self._kinds, values, strict=True):
            if "[" in kind:
                array = np.ascontiguousarray(value, kind[:2])
                kept.append(array)  # until the call has returned
                flat += [0, 0, array.size, array.itemsize, array.ctypes.data]
                flat += [*array.shape, *array.strides]
            else:
                flat.append(value)
        self._call(*flat)

    @property
    def is_made(self) -> bool:
        """Whether calling it takes no more than loading."""
        return self._call is not None or not _has_numba() or cached(self._file()) is not None

    def load(self) -> None:
        """Loads the machine code, which is made where the cache does not have it."""
        if not _has_numba():
            self._call = self.numpy
            return
        import llvmlite.binding as llvm

        code = cached(self._file()) or self._made()
        types: list[Any] = [ctypes.c_void_p] * 2
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        for kind in self._kinds:
            words = 5 + 2 * (kind.count(",") + 1)
            types += [ctypes.c_int64] * words if "[" in kind else [_NUMBERS[kind]]
        address = engine.get_function_address(self._code.__name__)
        self._engine = engine  # before the call: another thread may wait for that
        self._call = ctypes.CFUNCTYPE(ctypes.c_int32, *types)(address)

    def _made(self) -> bytes:
        """The machine code, by numba; kept where the cache can be written."""
        import llvmlite.binding as llvm
        from numba import njit
        from numba.extending import register_jitable

        for function in self._uses:
            register_jitable(error_model="numpy")(function)
        options: dict[str, Any] = {"error_model": "numpy", "_nrt": False}  # no memory of its own
        options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        compiler = njit(f"({', '.join(self._kinds)},)", **options)
        (text,) = compiler(self._code).inspect_llvm().values()
        own = r'^define (?!linkonce|internal)[^@]*i32 @"?([^"(]+)"?\('  # helpers may be linked in
        (mangled,) = re.findall(own, text, re.MULTILINE)
        module = llvm.parse_assembly(text.replace(mangled, self._code.__name__))
        declared = [f.name for f in module.functions if f.is_declaration]
        unknown = [x for x in declared if "llvm." not in x and not llvm.address_of_symbol(x)]
        if unknown:  # LLVM would end the process where the code is loaded
            raise TypeError(f"{self._code.__name__} needs numba's own {unknown} at run time")
        code = bytes(_machine().emit_object(module))
        keep_cached(self._file(), code)
        return code

    def _file(self) -> Path:
        """In the cache, named by all that the code depends on."""
        import llvmlite

        functions = (self._code, *self._uses)
        modules = sorted({str(sys.modules[one.__module__].__file__) for one in functions})
        texts = [Path(name).read_text(encoding="utf-8") for name in modules]
        ground = [*texts, *self._kinds, llvmlite.__version__, *processor()]
        digest = hashlib.sha256("\0".join(ground).encode()).hexdigest()
        return cache_root() / "kernels" / f"{self._code.__name__.strip('_')}-{digest[:20]}.o"


def invert(matrix: Any, size: int) -> bool:
    """For loops: inverts a definite matrix in place (Gauss and Jordan); False where it is not."""
    for p in range(size):
        if not matrix[p, p] > 0.0:
            return False
        pivot, matrix[p, p] = 1.0 / matrix[p, p], 1.0
        for j in range(size):
            matrix[p, j] *= pivot
        for i in range(size):
            if i != p:
                factor, matrix[i, p] = matrix[i, p], 0.0
                for j in range(size):
                    matrix[i, j] -= factor * matrix[p, j]
    return True


def make_kernels(progress: Callable[[str, int, int], None]) -> None:
    """Makes those of all imported kernels that the cache does not have; reports each."""
    missing = [kernel for kernel in KERNELS if not kernel.is_made]
    for done, kernel in enumerate(missing, 1):
        kernel.load()
        progress("compiling (once)", done, len(missing))


def _has_numba() -> bool:
    """Whether it is installed, and not switched off by its own variable."""
    return find_spec("numba") is not None and os.environ.get("NUMBA_DISABLE_JIT", "0") == "0"


def processor() -> tuple[str, str]:
    """Name and features of the processor that machine code is made for, as numba takes them."""
    import llvmlite.binding as llvm

    name = os.environ.get("NUMBA_CPU_NAME") or llvm.get_host_cpu_name()
    own = "" if name == "generic" else llvm.get_host_cpu_features().flatten()
    return name, os.environ.get("NUMBA_CPU_FEATURES", own)


def _machine() -> Any:
    """LLVM's description of the processor."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = processor()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(name, features, 3, "default", "jitdefault", jit=True)
