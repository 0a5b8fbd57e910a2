"""A person as Gaussians on the skin of a body: bound to its faces, moved by its skinning."""

import torch
from torch import Tensor, nn

from monopart.fields import FrequencyEncoding, Gaussians
from monopart.geometry import (
    BodyModel,
    PosedBody,
    consistency_loss,
    inverse_skin,
    quat_wxyz_to_rotmat,
    round_trip,
)
from monopart.geometry.skinning import blend_transforms, skin

REACH = 0.05  # metres that a residual moves a point at most


class Residual(nn.Module):
    """Motion that skinning does not explain: rest points and a pose to offsets, at first zero."""

    def __init__(self, joints: int, width: int = 48) -> None:
        super().__init__()
        self.encoding = FrequencyEncoding(3, octaves=4)
        self.of_place = nn.Linear(self.encoding.out_features, width)
        self.of_pose = nn.Linear(3 * joints, width, bias=False)
        self.last = nn.Linear(width, 3)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.out = nn.Sequential(nn.ReLU(), nn.Linear(width, width), nn.ReLU(), self.last)

    def forward(self, points: Tensor, pose: Tensor) -> Tensor:
        """Offsets of rest points [N, 3] in a pose [J, 3], metres."""
        place = self.of_place(self.encoding(2 * torch.pi * points))
        return REACH * self.out(place + self.of_pose(pose.flatten())).tanh()


class GaussianAvatar(nn.Module):
    """Gaussians on the body in its rest pose, and the two residuals."""

    def __init__(self, body: BodyModel, betas: Tensor, count: int) -> None:
        super().__init__()
        self.body, self.rest_verts = body, body.shaped(betas)[0]
        face, bary, area = spread_over(self.rest_verts[body.faces], count)
        corners = self.rest_verts[body.faces[face]]
        self.anchors = (bary * corners).sum(1)
        self.weights = (bary * body.weights[body.faces[face]]).sum(1)
        along = nn.functional.normalize(corners[:, 1] - corners[:, 0], dim=-1)
        normal = torch.linalg.cross(along, corners[:, 2] - corners[:, 0])
        normal = nn.functional.normalize(normal, dim=-1)
        self.frames = torch.stack([along, torch.linalg.cross(normal, along), normal], -1)
        size = 0.6 * (area / count).sqrt()  # neighbours overlap and leave no gap; flat on the skin
        self.log_sizes = nn.Parameter((size * size.new_tensor([1, 1, 0.3])).log().repeat(count, 1))
        self.offsets = nn.Parameter(torch.zeros_like(self.anchors))  # metres, last along the normal
        self.quats = nn.Parameter(size.new_tensor([1, 0, 0, 0]).repeat(count, 1))
        self.opacity_logits = nn.Parameter(torch.full_like(self.anchors[:, 0], 2.0))
        self.color_logits = nn.Parameter(torch.zeros_like(self.anchors))
        residuals = [Residual(body.num_joints).to(size.device) for _ in range(2)]
        self.residuals = nn.ModuleList(residuals)  # forward and backward

    def rest_points(self) -> Tensor:
        """Middles of the Gaussians around the body in its rest pose, metres."""
        return self.anchors + (self.frames @ self.offsets[..., None])[..., 0]

    def forward(self, posed: PosedBody, pose: Tensor) -> Gaussians:
        """The Gaussians of a posed body, in the world."""
        rest, maps = self.rest_points(), blend_transforms(posed.transforms, self.weights)
        points = posed.to_world(skin(rest + self.residuals[0](rest, pose), maps))
        turned = posed.rotation @ maps[:, :3, :3] @ self.frames  # rotations blended, as they skin
        factors = turned @ (quat_wxyz_to_rotmat(self.quats) * self.log_sizes.exp()[:, None])
        return Gaussians(
            points, factors, self.opacity_logits.sigmoid(), self.color_logits.sigmoid()
        )

    def inconsistency(self, posed: PosedBody, pose: Tensor, rows: Tensor, above: float) -> Tensor:
        """Mean way of Gaussians to the posed body and back, metres, of ways longer than ``above``.

        Backward, skinning weights are found anew by inverse skinning; a point that it finds on
        another limb that touches, or nowhere, is left out.
        """
        maps = blend_transforms(posed.transforms, self.weights[rows])

        def forward(rest: Tensor) -> Tensor:
            return skin(rest + self.residuals[0](rest, pose), maps)

        def backward(points: Tensor) -> Tensor:
            found = inverse_skin(points, posed, self.body, rest_verts=self.rest_verts)
            rest = torch.where(found.valid[:, None], found.points, 10.0)
            return rest + self.residuals[1](rest, pose)

        gap = round_trip(self.rest_points()[rows], forward, backward)
        return consistency_loss(gap[gap < 2 * REACH], above)


def spread_over(corners: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Even places on triangles [F, 3, 3]: faces [N], barycentrics [N, 3, 1]; and the whole area."""
    sides = corners[:, 1:] - corners[:, :1]
    ends = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=-1).double().cumsum(0) / 2
    step = torch.arange(count, device=corners.device, dtype=torch.float64)
    face = torch.searchsorted(ends, (step + 0.5) / count * ends[-1]).clamp_max(len(ends) - 1)
    # multiples of two irrational numbers fill the unit square evenly; its upper half is folded down
    u, v = (step * 0.754877666) % 1, (step * 0.569840291) % 1
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    return face, torch.stack([1 - u - v, u, v], -1)[..., None].to(corners), ends[-1].to(corners)
