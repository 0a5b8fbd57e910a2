"""How light falls on a sample, as far as the training cameras can tell (beyond the paper)."""

import weakref
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from monopart.fields.irradiance import NUM_IRRADIANCE, ZONAL, irradiance_basis
from monopart.geometry.cameras import Camera
from monopart.geometry.posed_parts import PartPairs, PosedParts
from monopart.geometry.rotations import axis_angle_to_rotmat

from .captures.records import CaptureRecord

GRAZING = 0.2
"""Cosine down to which a camera sees well how light falls on a surface."""
BEHIND, FADE = -0.95, 0.5
"""Cosine from which on nothing is known of the light on a surface, and width of the way there."""
TUMBLES = 0.5
"""Length of the mean of a person's unit vectors upwards below which there is no such way."""


class Light(torch.nn.Module):
    """Harmonics of the normal below a sample, in axes whose third points up.

    A surface that looks away from all training cameras is lit like one that is bent back towards
    the nearest until that sees it: what falls from above and from the sides falls there too. One
    that looks straight away has the harmonics that are the same all around the third axis, and
    zeros for the others, as has a body whose light is switched off: nobody saw from which side
    light falls on it, and its colour is the mean over what was seen of surfaces as steep.
    """

    eyes: Tensor
    axes: Tensor
    around: Tensor

    def __init__(self, cameras: Sequence[Camera], up: Tensor) -> None:
        """Remember where the cameras stand; there is nothing to learn.

        Args:
            cameras: the training cameras.
            up: [3] unit vector away from the ground, in the world.
        """
        super().__init__()
        self._known: tuple[weakref.ref[PosedParts], Tensor] | None = None
        self.register_buffer("eyes", torch.stack([c.center for c in cameras]), persistent=False)
        first = cameras[0].R.to(up)  # not of the world: a capture may be turned in it
        level = torch.linalg.cross(up, first[int((first @ up).abs().argmin())])
        level = functional.normalize(level, dim=0)
        axes = torch.stack([level, torch.linalg.cross(up, level), up])
        self.register_buffer("axes", axes, persistent=False)
        around = torch.zeros(NUM_IRRADIANCE).to(up)
        around[list(ZONAL)] = 1.0
        self.register_buffer("around", around, persistent=False)

    @classmethod
    def of(cls, record: CaptureRecord) -> "Light":
        """Light as the training split of a capture shows it.

        Args:
            record: the capture; up is where its person points in the mean.
        """
        split = record.split("train")
        cameras = [record.cameras[c] for c in split.cameras]
        turns = torch.stack([record.poses[f].rotation for f in split.frames])
        up = axis_angle_to_rotmat(turns)[..., 1].mean(0)
        if float(up.norm()) < TUMBLES:
            up = -cameras[0].R[1].to(up)
        return cls(cameras, functional.normalize(up, dim=0))

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
            shown = torch.lerp(self.around, torch.ones_like(self.around), lit[:, None])
            light = light * shown[body]
        return light if code is None else torch.cat([code, light], -1)

    @torch.no_grad()
    def _table(self, bodies: PosedParts) -> Tensor:
        """Light at the vertices, [B, V, 8]; made once for bodies that are asked again."""
        if self._known is not None and self._known[0]() is bodies:
            return self._known[1]
        normals = bodies.world_normals()
        towards = functional.normalize(self.eyes - bodies.translation[:, None], dim=-1)
        facing, nearest = (normals @ towards.mT).max(-1)
        eye = towards.take_along_dim(nearest[..., None], dim=1)
        lacking = (GRAZING - facing).clamp(min=0.0)
        bent = functional.normalize(normals + lacking[..., None] * eye, dim=-1)
        known = ((facing - BEHIND) / FADE).clamp(0.0, 1.0)
        share = (known * known * (3 - 2 * known))[..., None]
        straight, usual = (irradiance_basis(n @ self.axes.mT) for n in (normals, bent))
        table = torch.lerp(straight * self.around, usual, share)
        self._known = weakref.ref(bodies), table
        return table
