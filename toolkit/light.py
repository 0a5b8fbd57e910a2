"""How light falls on a sample, as far as the training cameras can tell (beyond the paper)."""

import weakref
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from monopart.fields.irradiance import NUM_IRRADIANCE, irradiance_basis
from monopart.geometry.cameras import Camera
from monopart.geometry.mesh_graph import face_areas
from monopart.geometry.posed_parts import PartPairs, PosedParts

GRAZING = 0.2
"""Cosine at which a camera sees a surface well; at its negative it does not see it."""


class Light(torch.nn.Module):
    """Harmonics of the normal below a sample, in the frame of the first training camera.

    They are counted from their mean over what the training cameras saw. A surface that looks away
    from all training cameras gets zeros, as does a body whose light is switched off: nobody saw how
    light falls on it, and it is shown as in the middle of what was seen.
    """

    eyes: Tensor
    axes: Tensor
    mean: Tensor

    def __init__(self, cameras: Sequence[Camera]) -> None:
        """Remember where the cameras stand; all that is learned is the mean of what they see.

        Args:
            cameras: the training cameras.
        """
        super().__init__()
        self._known: tuple[weakref.ref[PosedParts], Tensor] | None = None
        self.register_buffer("eyes", torch.stack([c.center for c in cameras]), persistent=False)
        self.register_buffer("axes", cameras[0].R.clone(), persistent=False)
        self.register_buffer("mean", torch.zeros(NUM_IRRADIANCE))

    @torch.no_grad()
    def center(self, bodies: PosedParts) -> None:
        """Take the mean over the surfaces of training bodies, as large as they look.

        Args:
            bodies: the training frames.
        """
        basis, facing = self._seen(bodies)
        verts, faces = (x.cpu().numpy() for x in (bodies.verts[0].double(), bodies.faces))
        area = torch.zeros(len(verts), dtype=torch.float64)
        area.index_add_(
            0,
            bodies.faces.cpu().flatten(),
            torch.from_numpy(face_areas(verts, faces)).repeat_interleave(3),
        )
        weight = facing.clamp_min(0.0) * area.to(facing)
        self.mean.copy_((basis * weight[..., None]).sum((0, 1)) / weight.sum().clamp_min(1e-12))
        self._known = None

    def forward(
        self,
        bodies: PosedParts,
        lit: Tensor | None,
        body: Tensor,
        pairs: PartPairs,
        rows: Tensor,
        code: Tensor | None = None,
    ) -> Tensor:
        """Light on the surface below some pairs, [N, 8], behind the feature that they have already.

        Args:
            bodies: the bodies.
            lit: [B] 0 for a body whose light is switched off, else 1; None: all are lit.
            body: [N] body of each point.
            pairs: the pairs.
            rows: [N] which of them.
            code: [N, C] their feature; None: they have none.
        """
        light = bodies.interpolate(self._table(bodies), body, pairs.face[rows], pairs.bary[rows])
        if lit is not None:
            light = light * lit[body, None]
        return light if code is None else torch.cat([code, light], -1)

    @torch.no_grad()
    def _table(self, bodies: PosedParts) -> Tensor:
        """Light at the vertices, [B, V, 8]; made once for bodies that are asked again."""
        if self._known is not None and self._known[0]() is bodies:
            return self._known[1]
        basis, facing = self._seen(bodies)
        seen = ((facing + GRAZING) / (2 * GRAZING)).clamp(0.0, 1.0)
        share = seen * seen * (3 - 2 * seen)
        table = (basis - self.mean) * share[..., None]
        self._known = weakref.ref(bodies), table
        return table

    def _seen(self, bodies: PosedParts) -> tuple[Tensor, Tensor]:
        """Harmonics at the vertices, and the cosine at which a camera sees them best."""
        normals = bodies.world_normals()
        towards = functional.normalize(self.eyes - bodies.translation[:, None], dim=-1)
        return irradiance_basis(normals @ self.axes.mT), (normals @ towards.mT).amax(-1)
