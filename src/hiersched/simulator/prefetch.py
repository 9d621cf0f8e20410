"""Ask for memory before it is written."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

_WORDS_PER_LINE = 8


@intrinsic
def _prefetch_for_write(typing_context: Any, row: Any, word: Any) -> Any:
    """Ask for the cache line of a word that will be written; changes nothing."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = builder.bitcast(builder.gep(array.data, [arguments[1]]), cgutils.voidptr_t)
        i32 = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, i32, i32, i32])
        prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(prefetch, [place, i32(1), i32(3), i32(1)])  # write, keep close, data
        return context.get_dummy_value()

    return types.none(row, types.intp), generate


@njit(inline="always")
def prefetch_third(row: NDArray[Any], third: int) -> None:
    """Ask for one third of a row (words,) of 64-bit words.

    All of a slot's row at once would be more lines than a core can wait for.
    """
    words = row.shape[0]
    for word in range(third * words // 3, (third + 1) * words // 3, _WORDS_PER_LINE):
        _prefetch_for_write(row, word)
