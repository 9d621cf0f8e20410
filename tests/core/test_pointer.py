"""NamedTuples by pointer: what a kernel finds in every kind of field, and what it writes there."""

from __future__ import annotations

import gc
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba.core.errors import LoweringError, TypingError

from hiersched.core.compiled import kernel
from hiersched.core.pointer import Pointer


class Pair(NamedTuple):
    number: int
    values: Any


class Box(NamedTuple):
    before: int
    value: Any
    inner: Pair
    after: float


class Scalars(NamedTuple):
    whole: int
    yes: bool
    no: bool
    real: float
    f32: np.float32
    f64: np.float64
    i8: np.int8
    i32: np.int32
    i64: np.int64
    u8: np.uint8
    u32: np.uint32
    u64: np.uint64
    numpy_bool: np.bool_


class Outer(NamedTuple):
    """Words of all lengths before each field: nested NamedTuples of both sorts, arrays."""

    first: float
    table: Any
    box: Box
    flag: bool
    same: Pair
    numbers: Scalars
    cube: Any
    last: np.float32


SCALARS = Scalars(
    -(2**62) - 1, True, False, 0.1, np.float32(0.1), np.float64(-1e300), np.int8(-100),
    np.int32(-(2**31)), np.int64(-(2**63)), np.uint8(200), np.uint32(2**32 - 1),
    np.uint64(2**64 - 1), np.bool_(True),
)  # fmt: skip


@kernel()
def read_scalars(me):
    return (
        me.whole,
        me.yes,
        me.no,
        me.real,
        me.f32,
        me.f64,
        me.i8,
        me.i32,
        me.i64,
        me.u8,
        me.u32,
        me.u64,
        me.numpy_bool,
    )


def assert_scalars(got):
    for name, one, expected in zip(Scalars._fields, got, SCALARS, strict=True):
        assert one == expected, name
        assert isinstance(one, bool) == isinstance(expected, bool | np.bool_), name


def test_numbers_of_every_kind():
    assert_scalars(read_scalars(Pointer(SCALARS)))


@kernel()
def halve_one(me):
    return me.f32 / np.float32(3.0), me.u32 + np.uint32(1), me.i64 - me.i8


def test_numbers_keep_their_type_in_the_kernel():
    third, more, less = halve_one(Pointer(SCALARS))
    assert third == SCALARS.f32 / np.float32(3.0)  # single precision, not double
    assert more == 2**32  # as Numba adds
    assert less == -(2**63) + 100


def numbers(shape, dtype=np.float64):
    count = int(np.prod(shape))
    return (np.arange(1, count + 1) * 1.25).reshape(shape).astype(dtype)


ARRAYS = {
    "0": numbers(()),
    "1": numbers(7),
    "2": numbers((3, 5)),
    "3": numbers((2, 3, 4)),
    "4": numbers((2, 3, 2, 5)),
    "float32": numbers((3, 5), np.float32),
    "int64": numbers((3, 5), np.int64),
    "uint32": numbers((3, 5), np.uint32),
    "uint8": numbers((3, 5), np.uint8),
    "bool": numbers((3, 5), np.int64) % 3 == 0,
    "empty": numbers((3, 0, 2)),
    "one": numbers((1, 1)),
    "strided": numbers(21)[2::3],
    "backwards": numbers((3, 5))[::-1, ::-2],
    "columns": numbers((4, 6))[:, 1:4],
    "fortran": np.asfortranarray(numbers((3, 5))),
    "transposed": numbers((2, 3, 4)).transpose(2, 0, 1),
    "middle": numbers((2, 3, 4, 5))[:, 1, :, ::2],
    "field": np.zeros((4, 2), [("a", np.float32), ("b", np.float64), ("c", np.uint32)])["b"],
    "repeated": np.lib.stride_tricks.as_strided(numbers(4), (3, 4), (0, 8)),
}


@kernel()
def look_and_write(me, given, out, shape):
    """Copy the array out, write another into it; its outline; what lies around it."""
    value = me.value
    for index in np.ndindex(value.shape):
        out[index] = value[index]
        value[index] = given[index]
    for d in range(value.ndim):
        shape[0, d] = value.shape[d]
        shape[1, d] = value.strides[d]
    return me.before, value.size, value.itemsize, me.inner.number, me.inner.values[1], me.after


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays_are_read_and_written_in_place(kind):
    array = ARRAYS[kind]
    if kind not in ("field", "repeated"):  # a copy would have another layout
        base = np.array(array.base if array.base is not None else array)
        array = (
            np.ndarray(array.shape, array.dtype, base, place_of(array), array.strides)
            if array.base is not None
            else array.copy(order="K")
        )
    before = array.copy()
    given = np.array(~before if before.dtype == bool else before + before.dtype.type(3))
    out, outline = np.zeros_like(before), np.zeros((2, 4), np.int64)
    inner = Pair(-9, np.array([0.5, 0.75]))
    got = look_and_write(Pointer(Box(7, array, inner, 2.5)), given, out, outline)
    assert got == (7, array.size, array.itemsize, -9, 0.75, 2.5)
    assert tuple(outline[0, : array.ndim]) == array.shape
    if array.size:
        assert tuple(outline[1, : array.ndim]) == array.strides
    if kind != "repeated":  # there a place is written before it is read again
        np.testing.assert_array_equal(out, before)
    np.testing.assert_array_equal(array, given)


def place_of(view):
    return view.ctypes.data - view.base.ctypes.data


def test_what_lies_around_a_view_stays():
    whole = numbers((4, 6))
    expected = whole.copy()
    part = whole[1:3, 1:5:2]
    given = np.full(part.shape, -1.0)
    box = Pointer(Box(0, part, Pair(0, np.zeros(2)), 0.0))
    look_and_write(box, given, np.zeros(part.shape), np.zeros((2, 4), np.int64))
    expected[1:3, 1:5:2] = -1.0
    np.testing.assert_array_equal(whole, expected)


@kernel()
def row_of(array, place):
    array[place] *= 2.0
    return array[place] + array[-1]


@kernel()
def go_on_with(me, out):
    """Rows, slices, reshaped and nested arrays, and parts handed on to other kernels."""
    row, column = me.table[1], me.table[:, 2]
    out[0], out[1], out[2] = row.sum(), column.sum(), me.table.reshape(-1)[4]
    out[3] = row_of(me.box.inner.values, 0)
    out[4] = row_of(me.same.values, 1)
    out[5] = row_of(me.cube[1, 0], 0)
    box = me.box
    out[6] = read_inner(box.inner)
    return read_scalars(me.numbers)


@kernel()
def read_inner(pair):
    return pair.number + pair.values[0]


@kernel()
def plain_fields(me):
    return me.first, me.flag, me.same.number, me.box.before, me.box.after, me.last


@pytest.fixture
def outer():
    pair = Pair(5, numbers(4))
    return Outer(
        first=0.125,
        table=numbers((3, 4)),
        box=Box(1, numbers(()), pair, -0.5),
        flag=True,
        same=Pair(6, numbers(3)),
        numbers=SCALARS,
        cube=numbers((2, 2, 3)),
        last=np.float32(0.3),
    )


def test_nested_fields_are_where_numpy_has_them(outer):
    assert plain_fields(Pointer(outer)) == (0.125, True, 6, 1, -0.5, np.float32(0.3))
    table, cube = outer.table.copy(), outer.cube.copy()
    values, same = outer.box.inner.values.copy(), outer.same.values.copy()
    out = np.zeros(7)
    assert_scalars(go_on_with(Pointer(outer), out))
    expected = [
        table[1].sum(),
        table[:, 2].sum(),
        table.ravel()[4],
        2 * values[0] + values[-1],
        2 * same[1] + same[-1],
        2 * cube[1, 0, 0] + cube[1, 0, -1],
        5 + 2 * values[0],
    ]
    assert out.tolist() == expected
    values[0] *= 2
    same[1] *= 2
    cube[1, 0, 0] *= 2
    np.testing.assert_array_equal(outer.box.inner.values, values)
    np.testing.assert_array_equal(outer.same.values, same)
    np.testing.assert_array_equal(outer.cube, cube)
    np.testing.assert_array_equal(outer.table, table)


class Even(NamedTuple):
    """All fields of one type, as in a point."""

    x: float
    y: float
    z: float


class Empty(NamedTuple):
    pass


class Around(NamedTuple):
    before: int
    empty: Empty
    even: Even
    after: int


@kernel()
def weigh_even(me):
    return me.before + 10.0 * me.even.x + 100.0 * me.even.y + 1000.0 * me.even.z, me.after


def test_fields_of_one_type_and_none_at_all():
    assert weigh_even(Pointer(Around(3, Empty(), Even(1.0, 2.0, 3.0), -4))) == (3213.0, -4)
    assert Pointer(Empty()).address


@kernel()
def first_value(me):
    return me.values[0] + me.number


def test_arrays_are_shared_and_numbers_copied():
    pair = Pair(10, np.array([1.0]))
    pointer = Pointer(pair)
    assert first_value(pointer) == 11.0
    pair.values[0] = 2.0
    assert first_value(pointer) == 12.0
    assert pointer.value is pair
    assert first_value(Pointer(pair._replace(number=20))) == 22.0
    assert first_value(pointer) == 12.0


def test_a_pointer_keeps_its_arrays():
    pointers = [Pointer(Pair(0, np.full(1000, float(i)))) for i in range(50)]
    gc.collect()
    rubbish = [np.full(1000, -1.0) for _ in range(50)]
    assert [first_value(pointer) for pointer in pointers] == list(map(float, range(50)))
    assert len(rubbish) == 50


def test_the_same_fields_are_the_same_type():
    """Else a kernel would be compiled for each of them."""
    first, second = Pointer(Pair(0, np.zeros(3))), Pointer(Pair(1, np.ones(8)))
    assert first.kind == second.kind
    assert hash(first.kind) == hash(second.kind)
    for other in (
        Pointer(Pair(0, np.zeros((3, 3)))),
        Pointer(Pair(0.0, np.zeros(3))),
        Pointer(Pair(0, np.zeros(6)[::2])),
        Pointer(Pair(0, np.zeros(3)), "another source"),
    ):
        assert other.kind != first.kind


@kernel()
def ask_for_another(me):
    return me.numbre


@kernel()
def write_number(me):
    me.number = 3


@kernel()
def write_first(me):
    me.values[0] = 3.0


def test_what_cannot_be_asked_for_is_an_error_of_the_compiler():
    pointer = Pointer(Pair(0, np.zeros(3)))
    with pytest.raises(TypingError, match="numbre"):
        ask_for_another(pointer)
    with pytest.raises((NotImplementedError, LoweringError), match="number"):
        write_number(pointer)
    shown = np.zeros(3)
    shown.flags.writeable = False
    assert first_value(Pointer(Pair(1, shown))) == 1.0
    with pytest.raises(TypingError, match="readonly array"):
        write_first(Pointer(Pair(0, shown)))


@pytest.mark.parametrize("value", ["text", None, 1j, (1, 2), [1.0]])
def test_other_fields_are_refused(value):
    with pytest.raises((TypeError, ValueError)):
        Pointer(Pair(0, value))
