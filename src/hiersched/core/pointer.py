"""NamedTuples by pointer: a kernel gets one address instead of a hundred arrays by value.

Every leaf of the tuple takes 8-byte words: a number one, an array the seven or more of its header.
The words are written from Python, so nothing is compiled to hand them over. They do not change
while a kernel runs, and its loads say so: the compiler may keep them in registers.

This leans on Numba's inner interfaces (array headers, attribute lowering), as `core.seam` and
`core.compiled` do; `make oldest` runs them on the oldest Numba that `pyproject.toml` allows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import typeof, types
from numba.core import cgutils
from numba.core.errors import NumbaAttributeError
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)
from numpy.typing import NDArray

_HEADER = ("meminfo", "parent", "nitems", "itemsize", "data")
"""Words of an array before its shape and strides, in the order of Numba's array structure."""
_WORD = 8


class PointerType(types.Type):
    """Pointer to the words of a NamedTuple; `sources` tells apart what else a kernel is made of."""

    def __init__(self, struct: types.NamedTuple, sources: str = "") -> None:
        self.struct = struct
        self.sources = sources
        super().__init__(name=f"Pointer({struct}, {sources})")

    @property
    def key(self) -> Any:
        """What makes two of these the same type."""
        return self.struct, self.sources


@register_model(PointerType)
class _PointerModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: PointerType) -> None:
        super().__init__(manager, kind, ir.IntType(64))


def _num_words(kind: types.Type) -> int:
    if isinstance(kind, types.BaseNamedTuple):
        return sum(map(_num_words, kind.types))
    return len(_HEADER) + 2 * kind.ndim if isinstance(kind, types.Array) else 1


@infer_getattr
class _PointerAttributes(AttributeTemplate):
    key = PointerType

    def generic_resolve(self, pointer: PointerType, name: str) -> types.Type | None:
        if name not in pointer.struct.fields:
            known = ", ".join(pointer.struct.fields) or "none"
            kind = pointer.struct.instance_class.__name__
            raise NumbaAttributeError(f"{kind} has no field {name!r}; its fields are {known}")
        kind = pointer.struct.types[pointer.struct.fields.index(name)]
        return PointerType(kind) if isinstance(kind, types.BaseNamedTuple) else kind


@lower_getattr_generic(PointerType)
def _load_field(context: Any, builder: Any, pointer: PointerType, value: Any, name: str) -> Any:
    """Load a field; a NamedTuple within is an address further on."""
    word = ir.IntType(64)
    index = pointer.struct.fields.index(name)
    place = _WORD * sum(map(_num_words, pointer.struct.types[:index]))
    kind = pointer.struct.types[index]
    if isinstance(kind, types.BaseNamedTuple):
        return builder.add(value, word(place))
    invariant = builder.module.add_metadata([])

    def load(number: int, llvm_type: Any) -> Any:
        address = builder.add(value, word(place + _WORD * number))
        loaded = builder.load(builder.inttoptr(address, llvm_type.as_pointer()))
        loaded.set_metadata("invariant.load", invariant)
        return loaded

    if not isinstance(kind, types.Array):
        stored = load(0, context.get_data_type(kind))
        return context.data_model_manager[kind].from_data(builder, stored)
    array = context.make_array(kind)(context, builder)
    for number, field in enumerate(_HEADER):
        setattr(array, field, load(number, getattr(array, field).type))
    dims = range(kind.ndim)
    shape = [load(len(_HEADER) + d, word) for d in dims]
    if kind.layout == "C":
        # Strides follow from the shape, so the compiler sees that rows lie side by side.
        step = word(context.get_abi_sizeof(context.get_data_type(kind.dtype)))
        strides: list[Any] = []
        for d in reversed(dims):
            strides.insert(0, step)
            step = builder.mul(step, shape[d])
    else:
        strides = [load(len(_HEADER) + kind.ndim + d, word) for d in dims]
    array.shape = cgutils.pack_array(builder, shape, ty=word)
    array.strides = cgutils.pack_array(builder, strides, ty=word)
    return array._getvalue()


class Pointer:
    """The words of a NamedTuple of numbers, NumPy arrays and such NamedTuples; keeps it alive.

    Its arrays are shared, its numbers copied: a kernel sees what is written into an array, not a
    number that changes. `sources`: see `PointerType`.
    """

    __slots__ = ("address", "kind", "value", "words")

    def __init__(self, value: Any, sources: str = "") -> None:
        self.value = value
        self.kind = PointerType(typeof(value), sources)
        self.words: NDArray[np.uint64] = np.zeros(max(1, _num_words(self.kind.struct)), np.uint64)
        _fill(value, self.kind.struct, self.words)
        self.address = self.words.ctypes.data


def _fill(value: Any, kind: types.Type, words: NDArray[np.uint64]) -> None:
    if isinstance(kind, types.BaseNamedTuple):
        place = 0
        for part, part_kind in zip(value, kind.types, strict=True):
            count = _num_words(part_kind)
            _fill(part, part_kind, words[place : place + count])
            place += count
    elif isinstance(kind, types.Array):
        words[2 : len(_HEADER)] = value.size, value.itemsize, value.ctypes.data
        words.view(np.int64)[len(_HEADER) :] = *value.shape, *value.strides
    else:
        dtype = np.dtype(np.bool_ if kind == types.boolean else str(kind))
        words.view(dtype)[0] = value


@typeof_impl.register(Pointer)
def _typeof(value: Pointer, context: Any) -> PointerType:
    return value.kind


@unbox(PointerType)
def _unbox(kind: PointerType, value: Any, c: Any) -> Any:
    address = c.pyapi.object_getattr_string(value, "address")
    native = c.pyapi.long_as_longlong(address)
    c.pyapi.decref(address)
    return NativeValue(native)
