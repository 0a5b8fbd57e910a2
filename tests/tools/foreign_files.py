"""Files as others leave them: good, odd and broken, of every kind that is read."""

import io
import struct
from pathlib import Path

import numpy as np

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = """ply
format ascii 1.0
comment written by hand
obj_info and by nobody else
element vertex 4
property float x
property float y
property float z
property float confidence
element face 2
property list uchar int vertex_index
property uchar flags
element edge 1
property int a
property int b
end_header
0 0 0 .5
1 0 0 .5
1 1 0 .5
0 1 0 .5
4 0 1 2 3 7
3 0 2 1 1
0 1
"""


def _binary_ply(order: str) -> bytes:
    name = {"<": "little", ">": "big"}[order]
    head = (
        f"ply\r\nformat binary_{name}_endian 1.0\r\nelement vertex 4\r\nproperty double x\r\n"
        "property double y\r\nproperty double z\r\nproperty uchar red\r\nproperty uchar green\r\n"
        "property uchar blue\r\nproperty uchar alpha\r\nelement face 2\r\n"
        "property list uint8 uint32 vertex_indices\r\nend_header\r\n"
    )
    body = b"".join(
        struct.pack(order + "dddBBBB", x, y, 0, 255, 0, 51, 255)
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))
    )
    body += struct.pack(order + "BIIII", 4, 0, 1, 2, 3) + struct.pack(order + "BIII", 3, 0, 2, 1)
    return head.encode() + body


def _mac_ply() -> bytes:
    head, body = _binary_ply("<").split(b"end_header\r\n")
    return head.replace(b"\r\n", b"\r") + b"end_header\r" + body


def _stl(count: int, said: int | None = None) -> bytes:
    rng = np.random.default_rng(count)
    rows = b"".join(struct.pack("<12fH", 0, 0, 1, *rng.random(9).tolist(), 0) for _ in range(count))
    return b"solid but binary".ljust(80) + struct.pack("<I", count if said is None else said) + rows


def _npz(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def good_files() -> dict[str, bytes]:
    """Files that must be read."""
    return {
        "quad.obj": b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n",
        "negative.obj": (TRIANGLE + "f -3 -2 -1\n").encode(),
        "dos.obj": (TRIANGLE + "vn 0 0 1\ng a\ns off\nf 1//1 2//1 3//1\n")
        .replace("\n", "\r\n")
        .encode(),
        "continued.obj": (TRIANGLE + "f 1 \\\n2 \\\n3\n").encode(),
        "ngon.obj": b"".join(b"v %f %f 0\n" % (np.cos(a), np.sin(a)) for a in np.arange(7.0) * 0.89)
        + b"f 1 2 3 4 5 6 7\n",
        "no_material.obj": ("mtllib gone.mtl\nusemtl x\n" + TRIANGLE + "f 1 2 3\n").encode(),
        "latin.obj": b"# caf\xe9\no caf\xe9\n" + TRIANGLE.encode() + b"f 1 2 3\n",
        "bom.obj": b"\xef\xbb\xbf" + TRIANGLE.encode() + b"f 1 2 3\n",
        "mac.obj": (TRIANGLE + "f 1 2 3\n").replace("\n", "\r").encode(),
        "no_picture.obj": (
            "mtllib no_picture.obj\n# map_Kd lies in no comment\nmap_Kd -s 1 1 no_picture.obj\n"
            + TRIANGLE
            + "vt 0 0\nf 1/1 2/1 3/1\n"
        ).encode(),
        "some_colors.obj": b"v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0 0 1 0\nf 1 2 3\n",
        "homogeneous.obj": b"v 0 0 0 1\nv 1 0 0 1\nv 0 1 0 1\nf 1 2 3\nl 1 2\np 3\n",
        "half_textured.obj": (
            TRIANGLE + "vt 0 0\nvt 1 0 0\nvt 0 1\nf 1/1 2/2 3/3\nf 3 2 1\n"
        ).encode(),
        "points.obj": TRIANGLE.encode(),
        "имя 名.obj": (TRIANGLE + "f 1 2 3\n").encode(),
        "UPPER.OBJ": (TRIANGLE + "f 1 2 3\n").encode(),
        "many.ply": PLY.encode(),
        "little.ply": _binary_ply("<"),
        "big.ply": _binary_ply(">"),
        "bom.ply": b"\xef\xbb\xbf" + PLY.encode(),
        "mac.ply": PLY.replace("\n", "\r").encode(),
        "mac_binary.ply": _mac_ply(),
        "binary.stl": _stl(20),
        "nothing.stl": _stl(0),
        "text.stl": b"SOLID x\n FACET NORMAL 0 0 1\n outer loop\n  VERTEX 0 0 0\n  vertex 1e0 0 0\n"
        b"  vertex 0 1 0\n endloop\nendfacet\nENDSOLID x\n",
        "two_solids.stl": b"solid a\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendsolid a\n"
        b"solid b\nvertex 0 0 1\nvertex 1 0 1\nvertex 0 1 1\nendsolid b\n",
        "plain.npz": _npz(vertices=np.eye(3), faces=np.array([[0, 1, 2]])),
        "floats.npz": _npz(vertices=np.eye(3), faces=np.array([[0.0, 1.0, 2.0]])),
        "half.npz": _npz(v_template=np.eye(3, dtype=np.float16), f=np.array([[0, 1, 2]], "u4")),
    }


def bad_files() -> dict[str, bytes]:
    """Files that must be refused in one line."""
    return {
        "empty.obj": b"",
        "utf16.obj": (TRIANGLE + "f 1 2 3\n").encode("utf-16"),
        "utf16_bare.obj": (TRIANGLE + "f 1 2 3\n").encode("utf-16-be"),
        "utf16.ply": PLY.encode("utf-16"),
        "page.obj": b"<!DOCTYPE html>\n<html>404</html>",
        "page.stl": b"<html>".ljust(200),
        "pointer.glb": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n",
        "is_ply.obj": PLY.encode(),
        "is_glb.ply": struct.pack("<4sII", b"glTF", 2, 12),
        "is_zip.stl": _npz(v_template=np.eye(3)),
        "comma.obj": TRIANGLE.replace("0 1 0", "0,5 1,0 0,0").encode(),
        "letters.obj": (TRIANGLE + "f a b c\n").encode(),
        "slashes.obj": (TRIANGLE + "f / / /\n").encode(),
        "huge_index.obj": (TRIANGLE + "f 1 2 99999999999999999999\n").encode(),
        "empty_vt.obj": (TRIANGLE + "vt\nf 1/1 2/1 3/1\n").encode(),
        "words_vt.obj": (TRIANGLE + "vt a b\nf 1/1 2/1 3/1\n").encode(),
        "beyond_vt.obj": (TRIANGLE + "vt 0 0\nf 1/1 2/1 3/2\n").encode(),
        "words.obj": b"v a b c\nf 1 2 3\n",
        "two_numbers.obj": b"v 0 0\n",
        "beyond.obj": (TRIANGLE + "f 1 2 4\n").encode(),
        "zero.obj": (TRIANGLE + "f 0 1 2\n").encode(),
        "before.obj": (TRIANGLE + "f -4 -2 -1\n").encode(),
        "fraction.obj": (TRIANGLE + "f 1.5 2 3\n").encode(),
        "no_header.ply": b"ply\nformat ascii 1.0\n",
        "empty.ply": b"",
        "element.ply": PLY.replace("vertex 4", "vertex").encode(),
        "count.ply": PLY.replace("vertex 4", "vertex four").encode(),
        "property.ply": PLY.replace("float x", "float").encode(),
        "orphan.ply": PLY.replace("element vertex 4\n", "").encode(),
        "no_format.ply": PLY.replace("format ascii 1.0\n", "").encode(),
        "swapped.ply": _binary_ply("<").replace(b"binary_little", b"binary_big"),
        "fraction.ply": PLY.replace("4 0 1 2 3 7", "4 0 1.5 2 3 7").encode(),
        "nan_index.ply": PLY.replace("4 0 1 2 3 7", "4 0 nan 2 3 7").encode(),
        "short.ply": PLY.encode()[:-30],
        "unknown_type.ply": PLY.replace("float x", "quad x").encode(),
        "huge_count.ply": PLY.replace("vertex 4", "vertex 99999999999").encode(),
        "negative_count.ply": PLY.replace("vertex 4", "vertex -4").encode(),
        "no_positions.ply": PLY.replace("property float x", "property float q").encode(),
        "beyond.ply": PLY.replace("4 0 1 2 3 7", "4 0 1 2 9 7").encode(),
        "cut.ply": _binary_ply("<")[:-3],
        "empty.stl": b"",
        "longer.stl": _stl(5) + b"more",
        "count.stl": _stl(5, said=6),
        "huge.stl": _stl(5, said=2**32 - 1),
        "not_ended.stl": b"solid x\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n",
        "odd.stl": b"solid x\nvertex 0 0 0\nvertex 1 0 0\nendsolid\n",
        "words.stl": b"solid x\nvertex a b c\nvertex 1 0 0\nvertex 0 1 0\nendsolid\n",
        "empty.glb": b"",
        "magic.glb": b"glTF",
        "old.glb": struct.pack("<4sII", b"glTF", 1, 12),
        "long.glb": struct.pack("<4sII", b"glTF", 2, 4000) + b"\0" * 40,
        "text.gltf": b"not json",
        "list.gltf": b"[]",
        "bare.gltf": b'{"asset": {"version": "2.0"}}',
        "deep.gltf": b"[" * 100000,
        "empty.npz": b"",
        "fraction.npz": _npz(v_template=np.eye(3), f=np.array([[0, 1, 1.5]])),
        "names.npz": _npz(x=np.eye(3)),
        "shape.npz": _npz(v_template=np.eye(4), f=np.array([[0, 1, 2]])),
        "words.npz": _npz(v_template=np.array(["a"]), f=np.array([[0, 1, 2]])),
        "beyond.npz": _npz(v_template=np.eye(3), f=np.array([[0, 1, 7]])),
        "tree.npz": _npz(
            v_template=np.eye(3),
            f=np.array([[0, 1, 2]]),
            weights=np.ones((3, 2)),
            joints=np.eye(3)[:2],
            parents=np.array([1, 0]),
        ),
        "cut.npz": _npz(v_template=np.eye(3), f=np.array([[0, 1, 2]]))[:-40],
        "picture.png": b"\x89PNG\r\n",
    }


def written(folder: Path, files: dict[str, bytes]) -> list[Path]:
    """Write files into a folder."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return [folder / name for name in files]
