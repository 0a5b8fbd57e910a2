"""What a file is when it is not the mesh that its name promises."""

from pathlib import Path

from monopart.geometry.errors import InputError

_HEAD = 512
_KINDS: tuple[tuple[bytes, str, tuple[str, ...], str], ...] = (
    (b"ply\n", "a PLY file", (".ply",), "rename it to end in .ply"),
    (b"ply\r", "a PLY file", (".ply",), "rename it to end in .ply"),
    (b"glTF", "a binary glTF file", (".glb", ".gltf"), "rename it to end in .glb"),
    (b"PK\x03\x04", "a zip archive", (".npz",), "unpack it, or rename it to .npz if it is one"),
    (b"Kaydara FBX", "an FBX file", (), "export it as glb"),
    (b"OFF", "an OFF file", (), "export it as ply or obj"),
    (b"<!doctype html", "a web page", (), "download the file itself"),
    (b"<html", "a web page", (), "download the file itself"),
    (b"version https://git-lfs", "a pointer of Git LFS", (), "fetch the file by git lfs pull"),
    (b"\xff\xfe", "text in UTF-16", (".gltf",), "save it as UTF-8"),
    (b"\xfe\xff", "text in UTF-16", (".gltf",), "save it as UTF-8"),
)
"""First bytes, what they tell, the endings that may have them, and what to do otherwise."""


def refuse_other_kinds(path: Path) -> None:
    """Refuse a file whose first bytes are those of something else, and say what it is.

    Args:
        path: a file that ends like a mesh.

    Raises:
        InputError: it is empty, or of another kind than its ending says.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    if not head:
        raise InputError(
            f"{path}: expected a mesh, found an empty file; export or download it again"
        )
    ending = path.suffix.lower()
    for start, name, endings, fix in _KINDS:
        if head[: len(start)].lower() == start.lower() and ending not in endings:
            raise InputError(f"{path}: expected a {ending} file, found {name}; {fix}")
