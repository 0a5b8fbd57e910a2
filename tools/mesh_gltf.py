"""glTF 2.0 files, binary and text, with their skin."""

from pathlib import Path

from .gltf_file import GltfFile
from .gltf_read import mesh_of
from .gltf_write import packed_mesh
from .meshio import Mesh


def read(path: Path) -> Mesh:
    """Read the default scene as one mesh in the place where a viewer shows it."""
    return mesh_of(GltfFile(path))


def write(path: Path, mesh: Mesh, target: Path, text: bool) -> None:
    """Write one file; the data of a gltf stand in it."""
    path.write_bytes(packed_mesh(mesh, str(target), binary=target.suffix.lower() == ".glb"))
