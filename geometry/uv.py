"""Texture coordinates stored per face corner, so that seams stay sharp."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor


@runtime_checkable
class FaceHit(Protocol):
    """Anything that names a face and a place in it, such as `SurfaceHit`."""

    @property
    def face(self) -> Tensor:
        """Face indices, (*b)."""
        ...

    @property
    def bary(self) -> Tensor:
        """Barycentric coordinates, (*b, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class UVMap:
    """Texture coordinates (u, v) of the three corners of each face."""

    corner_uv: Float[Tensor, "F 3 2"]
    """Coordinates per face corner, (F, 3, 2), usually in [0, 1]."""

    def at(self, hit: FaceHit) -> Float[Tensor, "*b 2"]:
        """Coordinates of surface points, interpolated inside one face, never across a seam.

        Args:
            hit: object with `.face` (*b) and `.bary` (*b, 3), e.g. a `SurfaceHit`.

        Returns:
            (u, v), (*b, 2); differentiable in the barycentric coordinates.

        >>> import torch, types
        >>> uv = UVMap(torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]]))
        >>> uv.at(types.SimpleNamespace(face=torch.tensor([0]), bary=torch.eye(3)[1:2])).tolist()
        [[1.0, 0.0]]
        """
        return self.at_faces(hit.face, hit.bary)

    def at_faces(
        self, face: Int[Tensor, "*b"], bary: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b 2"]:
        """Coordinates of points given by face and barycentric coordinates.

        Args:
            face: face indices, (*b); a negative index (nothing found) reads face 0.
            bary: barycentric coordinates, (*b, 3).

        Returns:
            (u, v), (*b, 2); differentiable in `bary` and in the map.
        """
        corners = self.corner_uv[face.clamp(min=0)]
        return (bary[..., None] * corners).sum(-2)

    def to(self, ref: Tensor) -> "UVMap":
        """The same map on a tensor's device and in its float dtype."""
        return UVMap(self.corner_uv.to(ref))
