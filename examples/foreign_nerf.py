"""Our consistency loss in a foreign dynamic NeRF, which warps to a still scene (as D-NeRF does)."""

import torch
from torch import Tensor, nn

from monopart.geometry import consistency_loss, round_trip


def scene(points: Tensor, time: Tensor) -> Tensor:
    """True colours of a waving striped block: what the images of the foreign method show."""
    still = points[:, 1:2] - 0.2 * torch.sin(4 * time + 3 * points[:, :1])
    return torch.sin(still * torch.tensor([3.0, 6.0, 9.0])) / 2 + 0.5


def train(weight: float = 0.03, steps: int = 300) -> tuple[list[float], list[float]]:
    """Colour errors, and mean ways of points there and back in metres, of each step."""
    torch.manual_seed(0)
    sizes = ((4, 64), (64, 64), (64, 3))  # of each network: a point and a time to three numbers
    layers = [[f for s in sizes for f in (nn.Linear(*s), nn.SiLU())][:-1] for _ in range(3)]
    nets = nn.ModuleList(nn.Sequential(*each) for each in layers)
    optimizer, errors, gaps = torch.optim.Adam(nets.parameters(), lr=3e-3), [], []
    for _ in range(steps):
        points, time = torch.rand(512, 3) - 0.5, torch.rand(512, 1)
        back, forth, color = (lambda p, f=f, t=time: f(torch.cat([p, t], -1)) for f in nets)
        error = (color(points + back(points)) - scene(points, time)).square().mean()
        gap = round_trip(points, lambda p, f=back: p + f(p), lambda p, f=forth: p + f(p))
        optimizer.zero_grad()
        (error + weight * consistency_loss(gap, threshold=0.005)).backward()
        optimizer.step()
        errors.append(error.item())
        gaps.append(gap.mean().item())
    return errors, gaps


if __name__ == "__main__":
    for weight in (0.0, 0.03):
        errors, gaps = train(weight)
        print(f"weight {weight}: colour {errors[-1]:.4f}, there and back {1e3 * gaps[-1]:.0f} mm")
