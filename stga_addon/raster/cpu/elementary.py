"""Exponential and logarithm for loops that LLVM vectorizes: the C library's are calls, one value at
a time. And what Python has no name for: prefetching, operations that threads cannot divide, and
Python's own locks, which work without the GIL."""

import platform
import sys
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from . import inline_jit

LOG2E = np.float32(1.4426950408889634)
"""log₂ e: e^x = 2^(x · log₂ e)."""
LN2 = np.float32(0.6931471805599453)
"""ln 2: 2^x = e^(x · ln 2)."""
SQRT_HALF_BITS = np.int32(0x3F3504F3)
"""The bits of √½ in float32: subtracted from those of a number, they leave its exponent above those
of its fraction."""
# Coefficients of p in e^r = 1 + r + r²·p(r), |r| ≤ ln(2) / 2, by least squares in Chebyshev's
# nodes.
E2 = np.float32(4.999998791e-1)
E3 = np.float32(1.666651248e-1)
E4 = np.float32(4.166964626e-2)
E5 = np.float32(8.369628373e-3)
E6 = np.float32(1.374882306e-3)


@inline_jit
def exponential(x):
    """e^x to 2e-7 relative; at least 1.6e-38, infinite from 88.4 on."""
    bounded = min(max(x, np.float32(-87.0)), np.float32(89.0))
    whole = np.floor(bounded * LOG2E + np.float32(0.5))
    r = bounded - whole * LN2  # one rounding, where the processor multiplies and adds at once
    p = E6
    p = p * r + E5
    p = p * r + E4
    p = p * r + E3
    p = p * r + E2
    p = p * r * r + r + np.float32(1.0)
    value = p * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)
    return value if x == x else x


@inline_jit
def logarithm(x):
    """ln x to 2e-7, absolute or relative, of a positive normal number; some −87 for 0; undefined
    for others."""
    bits = np.float32(x).view(np.int32)
    whole = np.int32(np.int32(bits - SQRT_HALF_BITS) >> np.int32(23))
    m = np.int32(bits - np.int32(whole << np.int32(23))).view(np.float32)  # √½ to √2
    s = (m - np.float32(1.0)) / (m + np.float32(1.0))
    ss = s * s
    p = np.float32(2 / 9)
    p = p * ss + np.float32(2 / 7)
    p = p * ss + np.float32(2 / 5)
    p = p * ss + np.float32(2 / 3)
    return np.float32(whole) * LN2 + (p * ss * s + np.float32(2.0) * s)


@intrinsic
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Ask memory for the element of a contiguous array that has the given index in its flat form;
    does not wait."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.bitcast(builder.gep(data, [arguments[1]]), ir.PointerType(ir.IntType(8)))
        integer = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [address.type, integer, integer, integer])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        builder.call(function, [address, integer(0), integer(3), integer(1)])  # to read, keep, data
        return context.get_dummy_value()

    return types.void(array, index), generate


@intrinsic
def fetch_add(typing: Any, array: Any, index: Any, step: Any) -> Any:
    """Add `step` to an element of an int64 array, undivided by other threads; returns what it was
    before."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.gep(data, [arguments[1]])
        return builder.atomic_rmw("add", address, arguments[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), generate


@intrinsic
def exchange(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Replace an element of an int64 array, undivided by other threads; returns what it was."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.gep(data, [arguments[1]])
        return builder.atomic_rmw("xchg", address, arguments[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), generate


@intrinsic
def latest(typing: Any, array: Any, index: Any) -> Any:
    """An element of an int64 array as other threads have left it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.load_atomic(builder.gep(data, [arguments[1]]), "seq_cst", 8)

    return types.int64(array, types.int64), generate


@intrinsic
def pause(typing: Any) -> Any:
    """Let the other thread of the processor's core go ahead for some ten to a hundred cycles."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        machine = platform.machine()
        if machine in ("x86_64", "AMD64"):
            kind = ir.FunctionType(ir.VoidType(), [])
            name = "llvm.x86.sse2.pause"
            builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [])
        elif machine in ("arm64", "aarch64"):
            kind = ir.FunctionType(ir.VoidType(), [ir.IntType(32)])
            hint = cgutils.get_or_insert_function(builder.module, kind, "llvm.aarch64.isb")
            builder.call(hint, [ir.IntType(32)(15)])
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def yield_processor(typing: Any) -> Any:
    """Let other threads go ahead."""
    name = "SwitchToThread" if sys.platform == "win32" else "sched_yield"

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(32), [])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [])
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def acquire(typing: Any, lock: Any) -> Any:
    """Wait until a lock of Python's C API, given by its address, is free, and take it."""
    return types.void(types.int64), _lock_call("PyThread_acquire_lock", 1)


@intrinsic
def release(typing: Any, lock: Any) -> Any:
    """Release a lock of Python's C API, given by its address; any thread may."""
    return types.void(types.int64), _lock_call("PyThread_release_lock")


def _lock_call(name: str, *options: int) -> Any:
    integer = ir.IntType(32)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lock = builder.inttoptr(arguments[0], ir.PointerType(ir.IntType(8)))
        values = [lock, *map(integer, options)]
        kind = ir.FunctionType(integer, [value.type for value in values])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)
        return context.get_dummy_value()

    return generate
