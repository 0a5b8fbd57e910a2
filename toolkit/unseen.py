"""Residuals that no picture shows: the surface at times at which no camera looks at it.

A new view shows these places, and what a table holds there is left over from others.
"""

import torch
from torch import Tensor

from monopart.geometry.errors import MonopartError
from monopart.geometry.mesh_graph import face_areas
from monopart.geometry.parts import rows_of_parts
from monopart.geometry.posed_parts import PosedParts, full_bary

from .device import sent
from .losses import offset_loss
from .model import AvatarModel


class UnseenResiduals:
    """Random places of the canonical surface at random times, alike over area and time."""

    def __init__(self, canonical: PosedParts, count: int) -> None:
        """Weigh the faces.

        Args:
            canonical: the canonical body as the only body.
            count: places of a step.
        """
        verts, faces = (x.cpu().numpy() for x in (canonical.verts[0].double(), canonical.faces))
        total = torch.from_numpy(face_areas(verts, faces)).cumsum(0)
        self.ends = total / total[-1]
        self.canonical, self.count = canonical, count

    def loss(self, model: AvatarModel, generator: torch.Generator) -> Tensor:
        """Mean length of the backward residuals of places that are drawn, metres.

        Args:
            model: the avatar, with a backward residual.
            generator: draws places and times, on the host.
        """
        field, body = model.backward_residual, self.canonical
        if field is None:
            raise MonopartError("unseen residuals: expected a backward residual, found none")
        share = torch.rand(4, self.count, generator=generator)
        face = torch.searchsorted(self.ends, share[0].double()).clamp_max(len(self.ends) - 1)
        root = share[1].sqrt()
        bary = torch.stack([1.0 - root, root * (1.0 - share[2])], -1)
        face, bary, time = (sent(x, body.device) for x in (face, bary, share[3]))
        part, order = body.face_part[face].sort(stable=True)
        face, bary, time = face[order], full_bary(bary[order])[..., None], time[order]
        points = (body.verts[0][body.faces[face]] * bary).sum(1)
        uv = (body.corner_uv[face] * bary).sum(1)
        place = model.residual_place(points, uv, part, time)
        return offset_loss(field(place, part, rows_of_parts(part, model.num_parts)))
