"""Calling a compiled kernel with arguments that lie in memory, so that a thread needs no Python to
call it.

`store_entry` writes them to a team's words, with the address of a function that knows their types,
which `run_entry` calls.
"""

import hashlib
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.callconv import RETCODE_NONE, RETCODE_OK, excinfo_ptr_t
from numba.extending import intrinsic

from . import jit

ENTRY, KERNEL, FAILURE, EXCEPTION = 8, 9, 10, 11
"""Words of a team, int64: addresses of the function that calls the kernel, and of the kernel; the
code that the kernel returned if it failed, and the address of its exception."""
ARGUMENTS, ARGUMENTS_WORDS = 24, 2048
"""Where the arguments lie."""

_word = ir.IntType(64)
_entry_kind = ir.FunctionType(ir.VoidType(), [_word.as_pointer()])


def _words(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return context.make_array(signature.args[0])(context, builder, arguments[0]).data


def _at(builder: Any, words: Any, index: int) -> Any:
    return builder.gep(words, [_word(index)])


def number_of(kind: Any) -> int:
    """A number, int64, for a type: not the same for two of them."""
    digest = hashlib.sha256(str(kind).encode()).digest()
    return int(np.frombuffer(digest[:8], np.int64)[0])


@intrinsic
def number_of_type(typing: Any, value: Any) -> Any:
    """`number_of` the type of a value."""
    return types.int64(value), lambda *_: _word(number_of(value))


@intrinsic
def store_entry(typing: Any, words: Any, arguments: Any) -> Any:
    """Write a tuple of arguments to a team's words, with the function that calls a kernel with
    them."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data, value = _words(context, builder, signature, values), values[1]
        if context.get_abi_sizeof(value.type) > 8 * ARGUMENTS_WORDS:
            raise ValueError(f"{signature.args[1]} take more than {ARGUMENTS_WORDS} words")
        builder.store(
            value, builder.bitcast(_at(builder, data, ARGUMENTS), value.type.as_pointer())
        )
        function = _make_entry(context, builder.module, tuple(signature.args[1]), value.type)
        builder.store(builder.ptrtoint(function, _word), _at(builder, data, ENTRY))
        return context.get_dummy_value()

    return types.void(words, arguments), generate


def _make_entry(context: Any, module: Any, kinds: tuple[Any, ...], stored: Any) -> Any:
    """Add a function to the module that calls the kernel with the arguments of a team's words."""
    function = ir.Function(module, _entry_kind, module.get_unique_name("entry"))
    function.linkage = "internal"
    builder, (words,) = ir.IRBuilder(function.append_basic_block()), function.args
    value = builder.load(builder.bitcast(_at(builder, words, ARGUMENTS), stored.as_pointer()))
    arguments = [builder.extract_value(value, n) for n in range(len(kinds))]
    kind = context.call_conv.get_function_type(types.none, kinds)
    result = cgutils.alloca_once(builder, kind.args[0].pointee)
    exception = cgutils.alloca_once(builder, excinfo_ptr_t, zfill=True)
    kernel = builder.inttoptr(builder.load(_at(builder, words, KERNEL)), kind.as_pointer())
    code = builder.call(
        kernel, [result, exception, *context.get_arg_packer(kinds).as_arguments(builder, arguments)]
    )
    failed = builder.and_(
        builder.icmp_signed("!=", code, RETCODE_OK), builder.icmp_signed("!=", code, RETCODE_NONE)
    )
    with builder.if_then(failed, likely=False):
        builder.store(
            builder.ptrtoint(builder.load(exception), _word), _at(builder, words, EXCEPTION)
        )
        builder.store(builder.sext(code, _word), _at(builder, words, FAILURE))
    builder.ret_void()
    return function


@intrinsic
def run_entry(typing: Any, words: Any) -> Any:
    """Call the kernel with the arguments that `store_entry` wrote."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data = _words(context, builder, signature, values)
        function = builder.inttoptr(
            builder.load(_at(builder, data, ENTRY)), _entry_kind.as_pointer()
        )
        builder.call(function, [data])
        return context.get_dummy_value()

    return types.void(words), generate


@intrinsic
def _fail(typing: Any, words: Any) -> Any:
    """Return with the exception of a kernel that failed."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data, convention = _words(context, builder, signature, values), context.call_conv
        code = builder.trunc(builder.load(_at(builder, data, FAILURE)), ir.IntType(32))
        exception = builder.inttoptr(builder.load(_at(builder, data, EXCEPTION)), excinfo_ptr_t)
        with builder.if_then(builder.icmp_signed("!=", code, code.type(0))):
            convention.return_status_propagate(
                builder, convention._get_return_status(builder, code, exception)
            )
        return context.get_dummy_value()

    return types.void(words), generate


@jit
def raise_failure(words):
    """Raise the exception of a kernel that failed."""
    _fail(words)
