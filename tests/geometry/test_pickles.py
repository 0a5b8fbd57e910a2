"""The pickle reader: plain data of every origin come through, everything else is refused."""

import io
import pickle
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monopart.geometry.errors import InputError
from monopart.geometry.pickles import load_restricted

sparse = pytest.importorskip("scipy.sparse")


VALUES: list[Any] = [
    *(np.arange(6, dtype=d).reshape(2, 3) for d in ("f4", ">f8", "i2", "u1", "c16")),
    *(np.array(["ab", "c"]), np.array([b"ab", b"c"]), np.array([True, False])),
    *(np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.zeros((0, 3)), np.array(3.5)),
]


def test_arrays_round_trip_exactly() -> None:
    for protocol in range(6):
        for value in VALUES:
            found = load_restricted(io.BytesIO(pickle.dumps(value, protocol=protocol)), "file")
            assert found.dtype == value.dtype.newbyteorder("=") and found.flags.writeable
            np.testing.assert_array_equal(found, value)
            assert found.dtype.isnative
    scalars = [
        np.float32(1.5),
        np.int64(-3),
        np.bool_(True),
        1,
        2.5,
        "é",
        None,
        True,
        b"x",
        b"",
        bytearray(b"y"),
    ]
    for scalar in scalars:
        for protocol in range(6):
            found = load_restricted(io.BytesIO(pickle.dumps(scalar, protocol=protocol)), "file")
            assert found == scalar and type(found) is type(scalar)


@pytest.mark.parametrize("core", ["numpy.core", "numpy._core"])
def test_arrays_of_numpy_1_and_2(core: str) -> None:
    content = pickle.dumps({"a": np.arange(3.0), "b": np.float64(2)}, protocol=2)
    spelled = b"numpy._core" if b"numpy._core" in content else b"numpy.core"
    found = load_restricted(io.BytesIO(content.replace(spelled, core.encode())), "file")
    np.testing.assert_array_equal(found["a"], [0, 1, 2])
    assert found["b"] == 2


def test_array_written_by_python_2() -> None:
    content = (
        b"\x80\x02}q\x00U\x01Kq\x01cnumpy.core.multiarray\n_reconstruct\nq\x02cnumpy\nndarray\n"
        b"q\x03K\x00\x85U\x01b\x87R(K\x01K\x02\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<"
        b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x10"
        + np.array([1.5, -2.0]).tobytes()
        + b"tbs."
    )
    np.testing.assert_array_equal(load_restricted(io.BytesIO(content), "file")["K"], [1.5, -2.0])


def test_sparse_loads_where_scipy_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    matrix = sparse.csc_matrix(np.array([[0.0, 2], [3, 0], [0, 4]]))
    data = pickle.dumps(matrix, protocol=2)
    for module in [m for m in sys.modules if m.split(".")[0] == "scipy"]:
        monkeypatch.setitem(sys.modules, module, None)
    old = data.replace(b"scipy.sparse._csc", b"scipy.sparse.csc")  # the name of old versions
    assert old != data
    for content in (data, old):
        found = load_restricted(io.BytesIO(content), "file")
        np.testing.assert_array_equal(found, [[0, 2], [3, 0], [0, 4]])


@pytest.mark.parametrize(
    "code",
    [
        b"cnumpy\nndarray\n(I5\ntR.",  # an array over uninitialised memory
        b"cbuiltins\nset\n.",  # a class as data
        b"cnumpy\ndtype\n.",  # a function as data
        b"cnumpy\ndtype\n}X\x09\x00\x00\x00_functionNsb.",  # alters the reader
        b"cnumpy\ndtype\n(VV8\ntR.",  # raw memory, able to hide object pointers
        b"(lp0\ng0\na.",  # a list inside itself
        b"\x80\x02\x82\x01.",  # extension registry
        b"Ppersistent\n.",
        b"cbuiltins\nbytearray\n(L99999999999999L\ntR.",
        b"ccollections\n__builtins__\n.",
        b"\x80\x04\x8c\x0bcollections\x8c\x0fabc.sys.modules\x93.",
    ],
)
def test_hand_made_pickles_are_refused(code: bytes) -> None:
    if b"ndarray" in code:  # harmless: an empty stand-in, never an allocation
        assert load_restricted(io.BytesIO(code), "evil file").size == 0
        return
    with pytest.raises(InputError, match="evil file"):
        load_restricted(io.BytesIO(code), "evil file")


def array_pickle(shape: tuple[int, ...], dtype: str, data: Any) -> bytes:
    """A numpy array's pickle with a forged state."""
    empty = np.zeros(0, dtype=np.int8)
    function, args, _ = empty.__reduce__()

    class Forged:
        def __reduce__(self) -> tuple[Any, ...]:
            return function, args, (1, shape, np.dtype(dtype), False, data)

    return pickle.dumps(Forged(), protocol=2)


@pytest.mark.parametrize(
    ("shape", "dtype", "data"),
    [
        ((4,), "f8", b"\0" * 31),  # short
        ((4,), "f8", b"\0" * 40),  # long
        ((1 << 40,), "f8", b""),
        ((-1,), "f8", b"\0" * 8),
        ((2,), "O", b"\0" * 16),  # raw memory as object pointers
        ((2,), "O", [1]),
        ((1,), "M8[s]", b"\0" * 8),
        ((1,), "f8", 5),
        ((2, 2), [("a", "O"), ("b", "f8")], b"\0" * 64),
    ],
)
def test_forged_arrays_are_refused(shape: tuple[int, ...], dtype: str, data: Any) -> None:
    with pytest.raises(InputError, match="forged"):
        load_restricted(io.BytesIO(array_pickle(shape, dtype, data)), "forged")


def test_forged_sparse_matrices_are_refused() -> None:
    for spoil in ({"_shape": (1 << 20, 1 << 20)}, {"indices": np.array([0, 9])}, {"data": None}):
        matrix = sparse.csc_matrix(np.eye(2))
        matrix.__dict__.update(spoil)
        with pytest.raises(InputError, match="forged"):
            load_restricted(io.BytesIO(pickle.dumps(matrix, protocol=2)), "forged")


def test_reading_does_not_change_the_reader() -> None:
    """Data that follow a refused file are read as before."""
    with pytest.raises(InputError):
        load_restricted(io.BytesIO(b"cnumpy\ndtype\n}X\x04\x00\x00\x00codeNsb."), "evil")
    test_arrays_round_trip_exactly()


@given(st.binary(max_size=60), st.integers(0, 300), st.integers(0, 5))
def test_any_damage_gives_an_input_error_or_data(noise: bytes, at: int, protocol: int) -> None:
    value = {"a": np.arange(3.0), "b": ["x", 1, None], "c": sparse.csr_matrix(np.eye(2))}
    content = pickle.dumps(value, protocol=protocol)
    damaged = content[: at % len(content)] + noise + content[at % len(content) + len(noise) :]
    try:
        load_restricted(io.BytesIO(damaged), "noise")
    except InputError as error:
        assert "noise" in str(error) and "\n" not in str(error)
