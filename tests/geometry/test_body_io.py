"""Body files: every variant loads, nothing runs, every error names the file."""

import io
import os
import pickle
import sys
import types
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import oracles
import pytest
import torch

from monopart.geometry.body import BodyModel
from monopart.geometry.body_io import read_body, read_body_arrays, read_npy_object
from monopart.geometry.errors import InputError

sparse = pytest.importorskip("scipy.sparse")


class Reduced:
    """Pickles as a call of any function."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = (function, args)

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.call


def save_pickle(path: Path, value: Any, protocol: int = 2) -> Path:
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    return path


def save_object(path: Path, value: Any) -> Path:
    np.save(path, np.array(value, dtype=object), allow_pickle=True)
    return path


@pytest.fixture
def fake_chumpy() -> Iterator[types.ModuleType]:
    """A chumpy to write pickles with; it is gone again when they are read."""
    package, module = types.ModuleType("chumpy"), types.ModuleType("chumpy.ch")
    reordering = types.ModuleType("chumpy.reordering")

    class Ch:
        def __init__(self, **state: Any) -> None:
            self.__dict__.update(state)

    class Select(Ch):
        pass

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    Select.__module__, Select.__qualname__ = "chumpy.reordering", "Select"
    module.Ch, reordering.Select = Ch, Select  # pyright: ignore
    made = {"chumpy": package, "chumpy.ch": module, "chumpy.reordering": reordering}
    package.ch, package.reordering = module, reordering  # pyright: ignore
    sys.modules.update(made)
    yield package
    for name in made:
        sys.modules.pop(name, None)


def forget_chumpy() -> None:
    for name in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        del sys.modules[name]


# --- bodies ---------------------------------------------------------------------------------------


def assert_same_body(path: Path, arrays: dict[str, np.ndarray]) -> None:
    body = read_body(path)
    np.testing.assert_allclose(body.v_template, arrays["v_template"])
    np.testing.assert_array_equal(body.faces, arrays["f"])
    np.testing.assert_allclose(body.weights, arrays["weights"])
    np.testing.assert_allclose(body.joint_regressor, arrays["J_regressor"])
    np.testing.assert_allclose(body.shapedirs, arrays["shapedirs"])
    np.testing.assert_allclose(body.posedirs, arrays["posedirs"])
    assert body.tree.parents == (-1, 0, 0, 1, 3)
    model = BodyModel.load(path)
    assert model.num_joints == 5 and model.v_template.dtype == torch.float32


def test_npz(tmp_path: Path) -> None:
    arrays = oracles.random_body(0)
    np.savez(tmp_path / "body.npz", **arrays)
    assert_same_body(tmp_path / "body.npz", arrays)


@pytest.mark.parametrize("protocol", range(6))
def test_pkl_of_every_protocol(tmp_path: Path, protocol: int) -> None:
    arrays = oracles.random_body(0)
    extra = {"bs_style": "lbrs", "J_names": ["a"], "number": np.float64(3), "gender": b"f"}
    path = save_pickle(tmp_path / "body.pkl", OrderedDict({**arrays, **extra}), protocol)
    assert_same_body(path, arrays)


def test_names_of_smplh_and_smplx(tmp_path: Path) -> None:
    arrays = oracles.random_body(0)
    renamed = {"f": "faces", "weights": "lbs_weights"}
    other = {renamed.get(k, k): v for k, v in arrays.items() if k != "kintree_table"}
    other["faces"] = other["faces"].astype(np.uint32)
    other |= {"parents": np.array([-1, 0, 0, 1, 3]), "hands_componentsl": np.eye(45)}
    other["part2num"] = np.array({"head": 3}, dtype=object)
    np.savez(tmp_path / "body.npz", **other)
    assert_same_body(tmp_path / "body.npz", arrays)


@pytest.mark.parametrize(
    "kind", ["csc_matrix", "csr_matrix", "coo_matrix", "csc_array", "csr_array"]
)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_sparse_regressor(tmp_path: Path, kind: str, protocol: int) -> None:
    arrays = oracles.random_body(0)
    regressor = arrays["J_regressor"]
    regressor[regressor < 0.01] = 0
    assert 0 < (regressor == 0).mean() < 1
    path = tmp_path / "body.pkl"
    save_pickle(path, {**arrays, "J_regressor": getattr(sparse, kind)(regressor)}, protocol)
    assert_same_body(path, arrays)


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_chumpy_arrays_open_without_chumpy(
    tmp_path: Path, fake_chumpy: types.ModuleType, protocol: int
) -> None:
    arrays = oracles.random_body(0)
    ch, select = fake_chumpy.ch.Ch, fake_chumpy.reordering.Select
    wrapped: dict[str, Any] = dict(arrays)
    wrapped["v_template"] = ch(x=arrays["v_template"], _dirty_vars=set(), _itr=None)
    source = ch(x=arrays["shapedirs"].ravel()[::-1].copy())
    indices = np.arange(arrays["shapedirs"].size)[::-1].copy()
    shape = arrays["shapedirs"].shape
    wrapped["shapedirs"] = select(a=source, idxs=indices, preferred_shape=shape)
    path = save_pickle(tmp_path / "body.pkl", wrapped, protocol)
    forget_chumpy()
    assert_same_body(path, arrays)
    assert "chumpy" not in sys.modules


def test_chumpy_without_an_array_is_refused(tmp_path: Path, fake_chumpy: types.ModuleType) -> None:
    path = save_pickle(tmp_path / "body.pkl", {"v_template": fake_chumpy.ch.Ch(y=1)})
    forget_chumpy()
    with pytest.raises(InputError, match=r"body\.pkl.*chumpy\.ch\.Ch"):
        read_body_arrays(path)


def test_weights_within_tolerance_are_scaled(tmp_path: Path) -> None:
    arrays = oracles.random_body(0)
    arrays["weights"] *= 1.0005
    np.savez(tmp_path / "body.npz", **arrays)
    np.testing.assert_allclose(read_body(tmp_path / "body.npz").weights.sum(1), 1, atol=1e-15)


def test_missing_pose_blend_shapes_are_zero(tmp_path: Path) -> None:
    arrays = oracles.random_body(0)
    del arrays["posedirs"]
    np.savez(tmp_path / "body.npz", **arrays)
    model = BodyModel.load(tmp_path / "body.npz")
    assert model.posedirs.shape == (40, 3, 36) and not model.has_pose_blend_shapes


def test_uv_per_face_corner(tmp_path: Path) -> None:
    arrays = oracles.random_body(0)
    arrays["vt"] = np.random.default_rng(0).random((30, 2))
    arrays["ft"] = np.random.default_rng(1).integers(0, 30, arrays["f"].shape)
    np.savez(tmp_path / "body.npz", **arrays)
    model = BodyModel.load(tmp_path / "body.npz")
    assert model.uv is not None
    np.testing.assert_allclose(model.uv.corner_uv, arrays["vt"][arrays["ft"]], atol=1e-7)


def test_the_capture_carries_the_shipped_body(captures_dir: Path) -> None:
    path = captures_dir / "actor_a" / "body.npz"
    found, shipped = BodyModel.load(path), BodyModel.default()
    assert torch.equal(found.v_template, shipped.v_template)
    assert torch.equal(found.weights, shipped.weights)


# --- bad bodies -----------------------------------------------------------------------------------

DAMAGE: dict[str, tuple[str, Any]] = {
    "no_faces": ("f", lambda a: a.pop("f")),
    "no_tree": ("kintree_table", lambda a: a.pop("kintree_table")),
    "faces_out_of_range": ("f", lambda a: a["f"].__setitem__((0, 0), 40)),
    "negative_face": ("f", lambda a: a["f"].__setitem__((0, 0), -1)),
    "nan_vertex": ("v_template", lambda a: a["v_template"].__setitem__((3, 1), np.nan)),
    "inf_shape": ("shapedirs", lambda a: a["shapedirs"].__setitem__((3, 1, 0), np.inf)),
    "weights_sum": ("weights", lambda a: a["weights"].__setitem__(7, 0.3)),
    "zero_weights": ("weights", lambda a: a["weights"].__setitem__(7, 0.0)),
    "negative_weight": ("weights", lambda a: a["weights"].__setitem__(7, [2, -1, 0, 0, 0])),
    "weights_shape": ("weights", lambda a: a.update(weights=a["weights"][:, :4])),
    "few_vertices": ("weights", lambda a: a.update(weights=a["weights"][:-1])),
    "regressor_shape": ("J_regressor", lambda a: a.update(J_regressor=a["J_regressor"].T)),
    "posedirs_shape": ("posedirs", lambda a: a.update(posedirs=a["posedirs"][..., :-1])),
    "shapedirs_shape": ("shapedirs", lambda a: a.update(shapedirs=a["shapedirs"][:, :2])),
    "text_template": ("v_template", lambda a: a.update(v_template=np.array(["a"]))),
    "tree_cycle": ("kintree_table", lambda a: a["kintree_table"].__setitem__((0, 1), 3)),
    "ft_range": ("ft", lambda a: a.update(vt=np.zeros((2, 2)), ft=a["f"])),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_bad_arrays_are_named(tmp_path: Path, damage: str, suffix: str) -> None:
    name, spoil = DAMAGE[damage]
    arrays = oracles.random_body(0)
    spoil(arrays)
    path = tmp_path / f"wrong_body{suffix}"
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        save_pickle(path, arrays)
    with pytest.raises(InputError) as caught:
        BodyModel.load(path)
    message = str(caught.value)
    assert str(path) in message and name in message and "\n" not in message
    assert "expected" in message and "found" in message and ";" in message


@pytest.mark.parametrize("name", ["missing.npz", "missing.pkl", "folder.npz", "body.txt", "body"])
def test_missing_and_unknown_files(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(InputError, match=name):
        BodyModel.load(tmp_path / name)


def test_pickle_of_something_else(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"list\.pkl.*dict.*list"):
        read_body_arrays(save_pickle(tmp_path / "list.pkl", [1, 2]))


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_truncated_and_corrupt_bodies(tmp_path: Path, suffix: str) -> None:
    arrays = oracles.random_body(0)
    path = tmp_path / f"body{suffix}"
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        save_pickle(path, arrays)
    content = path.read_bytes()
    for cut in (0, 1, 5, 100, len(content) // 2, len(content) - 3):
        path.write_bytes(content[:cut])
        with pytest.raises(InputError, match="body") as caught:
            read_body_arrays(path)
        assert "\n" not in str(caught.value)
    path.write_bytes(b"not a body at all")
    with pytest.raises(InputError, match="body"):
        read_body_arrays(path)


def test_flipped_bytes_in_an_npz_member(tmp_path: Path) -> None:
    path = tmp_path / "body.npz"
    np.savez(path, v_template=np.zeros((50, 3)))
    content = bytearray(path.read_bytes())
    content[400] ^= 0xFF
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"body\.npz.*v_template\.npy"):
        read_body_arrays(path)


# --- nothing runs ---------------------------------------------------------------------------------

CALLS = {
    "system": (os.system, "posix.system"),
    "eval": (eval, "builtins.eval"),
    "exec": (exec, "builtins.exec"),
    "getattr": (getattr, "builtins.getattr"),
    "open": (open, "io.open"),
    "import": (__import__, "builtins.__import__"),
    "load": (np.load, "numpy.load"),
    "fromfile": (np.memmap, "numpy.memmap"),
}


def attack(name: str, tmp_path: Path) -> tuple[Reduced, str, Path]:
    function, spelled = CALLS[name]
    mark = tmp_path / "it_ran"
    argument = {"system": f"touch {mark}", "open": str(mark)}.get(
        name, f"__import__('pathlib').Path({str(mark)!r}).touch()"
    )
    return Reduced(function, *([argument, "w"] if name == "open" else [argument])), spelled, mark


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("form", ["pkl", "npy", "npz", "nested"])
def test_code_is_refused_and_not_run(tmp_path: Path, name: str, protocol: int, form: str) -> None:
    value, spelled, mark = attack(name, tmp_path)
    path = tmp_path / f"evil.{'pkl' if form == 'nested' else form}"
    if form == "pkl":
        save_pickle(path, value, protocol)
    elif form == "nested":
        inside = np.array([{"a": [value]}, None], dtype=object)
        save_pickle(path, {"v_template": inside}, protocol)
    else:
        buffer = io.BytesIO()
        header = {"descr": "|O", "fortran_order": False, "shape": ()}
        np.lib.format.write_array_header_1_0(buffer, header)
        buffer.write(pickle.dumps(value, protocol=protocol))
        if form == "npy":
            path.write_bytes(buffer.getvalue())
        else:
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("v_template.npy", buffer.getvalue())
    with pytest.raises(InputError) as caught:
        read_npy_object(path) if form == "npy" else read_body_arrays(path)
    message = str(caught.value)
    last = spelled.split(".")[-1]
    assert str(path) in message and f".{last}," in message and "\n" not in message
    assert not mark.exists()


# --- objects in .npy ------------------------------------------------------------------------------


def test_annots(tmp_path: Path) -> None:
    cameras = {
        "K": [np.eye(3), 2 * np.eye(3)],
        "D": [np.zeros((5, 1))] * 2,
        "R": [np.eye(3).tolist()] * 2,
        "T": [np.ones((3, 1))] * 2,
    }
    annots = {"cams": cameras, "ims": [{"ims": ["a/0.jpg", "b/0.jpg"]}]}
    found = read_npy_object(save_object(tmp_path / "annots.npy", annots))
    assert found["ims"] == annots["ims"] and found["cams"].keys() == cameras.keys()
    np.testing.assert_array_equal(found["cams"]["K"][1], 2 * np.eye(3))
    assert found["cams"]["R"] == cameras["R"]


def test_plain_and_object_arrays(tmp_path: Path) -> None:
    np.save(tmp_path / "plain.npy", np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(read_npy_object(tmp_path / "plain.npy"), [[0, 1, 2], [3, 4, 5]])
    np.save(tmp_path / "fortran.npy", np.asfortranarray(np.arange(6.0).reshape(2, 3)))
    np.testing.assert_array_equal(read_npy_object(tmp_path / "fortran.npy"), [[0, 1, 2], [3, 4, 5]])
    found = read_npy_object(save_object(tmp_path / "list.npy", [{"a": 1}, None]))
    assert found.shape == (2,) and found[0] == {"a": 1}
    assert read_npy_object(save_object(tmp_path / "text.npy", "text")) == "text"


def test_annots_of_the_captures_are_those_of_numpy(captures_dir: Path) -> None:
    path = captures_dir / "actor_a" / "annots.npy"
    found, expected = read_npy_object(path), np.load(path, allow_pickle=True).item()
    assert found["ims"] == expected["ims"]
    for name, arrays in expected["cams"].items():
        np.testing.assert_array_equal(np.stack(found["cams"][name]), np.stack(arrays))


@pytest.mark.parametrize("plain", [True, False])
def test_damaged_npy(tmp_path: Path, plain: bool) -> None:
    path = tmp_path / "annots.npy"
    if plain:
        np.save(path, np.arange(50.0))
    else:
        save_object(path, {"a": list(range(50))})
    content = path.read_bytes()
    for cut in (0, 3, 60, 130, len(content) - 1):
        path.write_bytes(content[:cut])
        with pytest.raises(InputError, match=r"annots\.npy") as caught:
            read_npy_object(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"gone\.npy"):
        read_npy_object(tmp_path / "gone.npy")
