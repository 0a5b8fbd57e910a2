"""A reader of pickles that executes nothing: arrays, sparse matrices and plain containers only.

Every global that a pickle names is answered by an inert stand-in; numpy's own machinery for arrays
and dtypes is not called either (a forged dtype can make it read foreign memory). The stand-ins are
turned into arrays afterwards, from their checked state. Pickles of Python 2 and 3 and of numpy 1
and 2 load alike; scipy and chumpy are never imported.
"""

import io
import pickle
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from .errors import InputError

MAX_ELEMENTS = 1 << 28
"""Arrays of more elements are taken for damage."""

BAD_DATA = (
    *(pickle.UnpicklingError, EOFError, ValueError, TypeError, LookupError, AttributeError),
    *(ImportError, MemoryError, OverflowError, RuntimeError, SyntaxError),
)
"""What a damaged pickle or array makes the standard library and numpy raise."""

_DTYPE_CODE = re.compile(r"O[0-9]?|[biufcSU][0-9]{1,6}")


class _Function:
    """A function that a pickle may call and cannot alter."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any) -> Any:
        return self._function(*args)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("the pickle tried to alter its reader")


class _Dtype:
    """State of a numpy dtype."""

    __slots__ = ("code", "order")

    def __init__(self, code: str, *_: Any) -> None:
        if not isinstance(code, str) or not _DTYPE_CODE.fullmatch(code):
            raise pickle.UnpicklingError(f"array of an unknown type {code!r}")
        self.code = "O" if code[0] == "O" else code
        self.order = "|"

    def __setstate__(self, state: Any) -> None:
        _version, order, subarray, names, fields = state[:5]
        if subarray is not None or names is not None or fields is not None:
            raise pickle.UnpicklingError("structured array")
        if order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"unknown byte order {order!r}")
        self.order = order

    @property
    def numpy(self) -> np.dtype:
        return np.dtype(self.code) if self.code == "O" else np.dtype(self.order + self.code)


class _Array:
    """State of a numpy array or (`is_scalar`) scalar."""

    __slots__ = ("data", "dtype", "fortran", "is_scalar", "shape")

    def __init__(self) -> None:
        self.shape: tuple[int, ...] = (0,)
        self.dtype = _Dtype("i1")
        self.fortran = False
        self.is_scalar = False
        self.data: Any = b""

    def __setstate__(self, state: Any) -> None:
        shape, dtype, fortran, data = state[-4:]
        if not isinstance(dtype, _Dtype) or not all(isinstance(n, int) for n in shape):
            raise pickle.UnpicklingError("unknown form of array")
        if isinstance(data, str):
            data = data.encode("latin1")
        self.shape, self.dtype, self.fortran, self.data = tuple(shape), dtype, bool(fortran), data

    def build(self, resolve: Callable[[Any], Any]) -> Any:
        order = "F" if self.fortran else "C"
        _check_size(self.shape)
        if self.dtype.code == "O":
            if not isinstance(self.data, list):
                raise pickle.UnpicklingError("object array from raw memory")
            flat = np.full(len(self.data), None, dtype=object)
            for place, item in enumerate(self.data):
                flat[place] = resolve(item)
        else:
            # a copy is writable and aligned; the native byte order is what torch takes
            flat = np.frombuffer(self.data, self.dtype.numpy)
            flat = flat.astype(self.dtype.numpy.newbyteorder("="))
        array = flat.reshape(self.shape, order=order)
        return array[()] if self.is_scalar else array


class _Object:
    """State of an object of chumpy or scipy.sparse; one subclass per class and file."""

    kind = ""
    __slots__ = ("state",)

    def __new__(cls, *_: Any) -> "_Object":
        made = object.__new__(cls)
        made.state = {}
        return made

    def __init__(self, *_: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) == 2:  # (dict, slots)
            state = state[0]
        if not isinstance(state, dict):
            raise pickle.UnpicklingError(f"unknown state of {self.kind}")
        self.state = state

    def build(self, resolve: Callable[[Any], Any]) -> np.ndarray:
        if self.kind.startswith("chumpy"):
            return self._chumpy(resolve)
        return self._sparse(resolve)

    def _chumpy(self, resolve: Callable[[Any], Any]) -> np.ndarray:
        if "x" in self.state:
            return np.asarray(resolve(self.state["x"]))
        if {"a", "idxs"} <= self.state.keys():  # a selection of another array's elements
            chosen = np.asarray(resolve(self.state["a"])).ravel()[resolve(self.state["idxs"])]
            shape = resolve(self.state.get("preferred_shape"))
            return chosen if shape is None else chosen.reshape(shape)
        raise pickle.UnpicklingError(f"{self.kind} without its array `x`")

    def _sparse(self, resolve: Callable[[Any], Any]) -> np.ndarray:
        state = {str(name).lstrip("_"): value for name, value in self.state.items()}
        rows, columns = (int(n) for n in resolve(state["shape"]))
        _check_size((rows, columns))
        data = np.asarray(resolve(state["data"]))
        if "indptr" in state:
            indices, indptr = np.asarray(resolve(state["indices"])), resolve(state["indptr"])
            major = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
            row, column = (indices, major) if "csc" in self.kind else (major, indices)
        elif "coords" in state:
            row, column = resolve(state["coords"])
        else:
            row, column = resolve(state["row"]), resolve(state["col"])
        if len(data) and (min(row.min(), column.min()) < 0 or not len(data) == len(row)):
            raise pickle.UnpicklingError(f"{self.kind} whose entries do not agree")
        dense = np.zeros((rows, columns), data.dtype)
        np.add.at(dense, (row, column), data)
        return dense


def _check_size(shape: tuple[int, ...]) -> None:
    size = 1
    for n in shape:
        size *= max(n, 0)
    if size > MAX_ELEMENTS or any(n < 0 for n in shape):
        raise pickle.UnpicklingError(f"array of shape {shape}")


def _array(*_: Any) -> _Array:
    return _Array()


def _scalar(dtype: Any, data: Any) -> _Array:
    made = _Array()
    made.__setstate__(((), dtype, False, data))
    made.is_scalar = True
    return made


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> _Array:
    made = _Array()
    made.__setstate__((shape, dtype, order == "F", bytes(data)))
    return made


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"text encoding {encoding!r}")
    return str(text).encode("latin1")


def _bytes(data: Any = b"") -> bytes:
    if not isinstance(data, bytes):  # a number would ask for that much memory
        raise pickle.UnpicklingError("unknown form of bytes")
    return data


def _bytearray(data: Any = b"") -> bytearray:
    return bytearray(_bytes(data))


def _reconstruct_object(cls: Any, base: Any, _state: Any) -> _Object:
    if not (isinstance(cls, type) and issubclass(cls, _Object)) or base is not object:
        raise pickle.UnpicklingError("unknown form of object")
    return cls()


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Function(_array),
    ("numpy", "dtype"): _Function(_Dtype),
    ("collections", "OrderedDict"): dict,
    ("_codecs", "encode"): _Function(_encode),
}
_ALLOWED |= {
    (module, "_reconstructor"): _Function(_reconstruct_object)
    for module in ("copyreg", "copy_reg")  # the second name is Python 2's
}
_ALLOWED |= {
    (f"numpy.{core}.{module}", name): _Function(function)
    for core in ("core", "_core")
    for module, name, function in (
        ("multiarray", "_reconstruct", _array),
        ("multiarray", "scalar", _scalar),
        ("numeric", "_frombuffer", _from_buffer),
    )
}
_ALLOWED |= {
    (module, kind.__name__): kind
    for module in ("builtins", "__builtin__")
    for kind in (set, frozenset, object)
}
_ALLOWED |= {
    (module, name): _Function(function)
    for module in ("builtins", "__builtin__")
    for name, function in (("bytes", _bytes), ("bytearray", _bytearray))
}
_SPARSE = re.compile(r"(csc|csr|coo)_(matrix|array)")


class _Reader(pickle.Unpickler):
    def __init__(self, stream: io.BufferedIOBase, source: str) -> None:
        super().__init__(stream, encoding="latin1")
        self._source = source
        self._stubs: dict[str, type[_Object]] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return _ALLOWED[module, name]
        is_chumpy = module == "chumpy" or module.startswith("chumpy.")
        if is_chumpy or (module.startswith("scipy.sparse") and _SPARSE.fullmatch(name)):
            kind = f"{module}.{name}"
            if kind not in self._stubs:
                self._stubs[kind] = type("Stub", (_Object,), {"kind": kind, "__slots__": ()})
            return self._stubs[kind]
        raise InputError(
            f"{self._source}: expected a pickle of plain arrays, found a call of {module}.{name}, "
            "which was refused and not run; get the file from a source you trust and save its "
            "arrays as .npz"
        )


class _Resolver:
    """Turns stand-ins into arrays through nested containers, each object once."""

    def __init__(self) -> None:
        self._done: dict[int, Any] = {}
        self._open: set[int] = set()

    def __call__(self, value: Any) -> Any:
        if not isinstance(value, (dict, list, tuple, set, frozenset, _Array, _Object, _Dtype)):
            if isinstance(value, (type, _Function)):
                raise pickle.UnpicklingError("a class or a function in place of data")
            return value
        key = id(value)
        if key not in self._done:
            if key in self._open:
                raise pickle.UnpicklingError("data that contain themselves")
            self._open.add(key)
            self._done[key] = self._build(value)
        return self._done[key]

    def _build(self, value: Any) -> Any:
        if isinstance(value, (_Array, _Object)):
            return value.build(self)
        if isinstance(value, _Dtype):
            return value.numpy
        if isinstance(value, dict):
            return {self(k): self(v) for k, v in value.items()}
        return type(value)(self(item) for item in value)


def load_restricted(stream: io.BufferedIOBase, source: str) -> Any:
    """The data of a pickle, without executing anything.

    Args:
        stream: the pickle.
        source: what to call it in errors.

    Returns:
        Numbers, text, containers and numpy arrays (sparse matrices dense).

    Raises:
        InputError: the pickle names any other global, or is damaged.
    """
    try:
        return _Resolver()(_Reader(stream, source).load())
    except InputError:
        raise
    except BAD_DATA as error:
        detail = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(
            f"{source}: expected a pickle of arrays, found a damaged one ({detail}); "
            "copy or download the file again"
        ) from error
